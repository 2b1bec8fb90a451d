#!/bin/sh
# Removes from the compiled modules below a folder what the dynamic linker does not read: debugging sections, a sixth of
# the API's packages, and local symbols, 4 MB of the API's packages and 55 MB of the worker's. Libraries in *.libs stay
# as they are, because the builders of wheels have moved their segments, and strip breaks such libraries.
set -eu
find "$1" -name '*.so' -type f -not -path '*.libs/*' -exec strip --strip-unneeded {} +
