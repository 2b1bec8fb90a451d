#!/bin/sh
# Prepares .clients, the environment in which tests/clients open assets with programs of others (deploy/clients.txt);
# goes on without it where Python 3.11 or a package is absent, and the tests are then skipped with the reason.
set -eu
cd "$(dirname "$0")/.."

say() { printf 'clients: %s\n' "$1" >&2; }

stamp=".clients/.installed-$(cksum <deploy/clients.txt | cut -d' ' -f1)"
[ -e "$stamp" ] && exit
python=${CLIENTS_BASE_PYTHON:-python3.11}
command -v "$python" >/dev/null && "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || {
    say "no Python 3.11 here, which Blender's module needs; install it or name it in CLIENTS_BASE_PYTHON"
    exit 0
}
"$python" -m venv --clear .clients
say "installing Blender's module, 374 MB, and what else deploy/clients.txt names into .clients"
if .clients/bin/python -m pip install --quiet --requirement deploy/clients.txt </dev/null; then
    touch "$stamp"
else
    say "not installed; pip's words are above"
fi
