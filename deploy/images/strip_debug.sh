#!/bin/sh
# Takes debugging sections out of the compiled modules below a folder: a sixth of the API's packages, and nothing reads
# them in a container. Libraries in *.libs stay as they are: wheels' builders have moved their segments, and strip
# breaks those.
set -eu
find "$1" -name '*.so' -type f -not -path '*.libs/*' | while read -r module; do
    if readelf --section-headers --wide "$module" | grep -q '\.debug_info'; then
        strip --strip-debug "$module"
    fi
done
