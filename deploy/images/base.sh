#!/bin/sh
# Makes the base of the images from Debian's packages, for a machine that cannot pull a public image:
#   deploy/images/base.sh NAME [SUITE]     NAME such as localhost/dentine-base, SUITE bookworm by default; give NAME as PYTHON_IMAGE
# Needs mmdebstrap, and podman or docker (DENTINE_ENGINE).
set -eu
name=${1:?give the name of the image}
suite=${2:-bookworm}
engine=${DENTINE_ENGINE:-$(command -v podman || command -v docker)}
exclude() { printf -- '--dpkgopt=path-exclude=%s ' "$@"; }
# Manuals, texts and translations are half of the files of such a root, and nothing reads them there. The hook merges
# /usr as usr-is-merged demands, which keeps apt from installing usrmerge and 50 MB of Perl for it.
# shellcheck disable=SC2046
mmdebstrap --quiet --variant=apt --include=python3,python3-venv,ca-certificates,usr-is-merged \
    --hook-dir=/usr/share/mmdebstrap/hooks/maybe-merged-usr \
    $(exclude '/usr/share/doc/*' '/usr/share/man/*' '/usr/share/locale/*' '/usr/share/info/*') \
    --customize-hook='rm -rf "$1"/var/cache/apt/archives/*.deb "$1"/var/lib/apt/lists/*' "$suite" - |
    "$engine" import - "$name"
