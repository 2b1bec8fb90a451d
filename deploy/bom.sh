#!/bin/sh
# Writes a CycloneDX bill of materials for each image: deploy/bom.sh FOLDER. The bills are made from the lock files and
# checked against the format's schema.
set -eu
folder=${1:?give the folder to write to}
cd "$(dirname "$0")/.."
[ -x .venv/bin/cyclonedx-py ] || .venv/bin/python -m pip install --quiet cyclonedx-bom
mkdir -p "$folder"
for image in api worker; do
    .venv/bin/cyclonedx-py requirements "deploy/images/$image.lock" --pyproject pyproject.toml --output-format JSON --validate --output-file "$folder/$image.cdx.json"
done
