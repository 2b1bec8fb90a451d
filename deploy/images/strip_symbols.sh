#!/bin/sh
# Takes out of the compiled modules below a folder what the dynamic linker does not read, debugging sections and local
# symbols: a fifth of the API's packages and 55 MB of the worker's. Libraries in *.libs stay as they are: wheels'
# builders have moved their segments, and strip breaks those.
set -eu
find "$1" -name '*.so' -type f -not -path '*.libs/*' -exec strip --strip-unneeded {} +
