#!/bin/sh
# Writes the lock files of the packages that each image installs, with versions and hashes:
# deploy/images/{build,api,worker}.lock. Needs network; commit the files.
#   deploy/lock.sh             keeps the versions that the files name already, where pyproject.toml still allows them
#   deploy/lock.sh --upgrade   takes the newest versions
set -eu
cd "$(dirname "$0")/.."
[ -x .venv/bin/uv ] || .venv/bin/python -m pip install --quiet uv
lock() {
    .venv/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url --custom-compile-command deploy/lock.sh "$@"
}
upgrade=${1:-}
lock ${upgrade:+"$upgrade"} --extra api --extra postgres --extra capture --output-file deploy/images/api.lock pyproject.toml
# miepython asks for matplotlib, about 50 MB with what that needs alone, to draw; no service has it draw.
lock ${upgrade:+"$upgrade"} --extra postgres --extra capture --extra worker --output-file deploy/images/worker.lock \
    --no-emit-package matplotlib --no-emit-package contourpy --no-emit-package cycler --no-emit-package fonttools \
    --no-emit-package kiwisolver --no-emit-package pyparsing --no-emit-package python-dateutil pyproject.toml
printf 'hatchling>=1.25\nnodejs-wheel>=22\n' | lock ${upgrade:+"$upgrade"} --output-file deploy/images/build.lock -
