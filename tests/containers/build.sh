#!/bin/sh
# Builds what tests/containers runs. Where the public bases cannot be pulled, set DENTINE_PYTHON_IMAGE to one that
# deploy/images/base.sh has made; a database is then built on it too. DENTINE_BUILD is the build command (default
# `docker build`), with whatever mounts or networks this machine needs; where it is podman's and the engine docker's,
# the images are handed over.
set -eu
cd "$(dirname "$0")/../.."
build=${DENTINE_BUILD:-docker build}
engine=${DENTINE_ENGINE:-docker}
python=${DENTINE_PYTHON_IMAGE:-docker.io/library/python:3.12-slim-bookworm}
hand_over() {
    case "$build" in
        podman*) [ "${engine#podman}" != "$engine" ] || podman save --quiet "$1" | $engine load --quiet ;;
    esac
}
for role in api worker; do
    name=$(eval "echo \${DENTINE_$(echo $role | tr a-z A-Z)_IMAGE:-dentine-$role}")
    $build --build-arg PYTHON_IMAGE="$python" --file deploy/images/Dockerfile --target $role --tag "$name" .
    hand_over "$name"
done
if [ -n "${DENTINE_PYTHON_IMAGE:-}" ]; then
    $build --build-arg PYTHON_IMAGE="$python" --file tests/containers/postgres.Dockerfile --tag "$DENTINE_POSTGRES_IMAGE" tests/containers
    hand_over "$DENTINE_POSTGRES_IMAGE"
fi
