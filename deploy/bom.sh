#!/bin/sh
# Writes what each image is made of as CycloneDX bills of material: deploy/bom.sh FOLDER. They are made of the locks and
# checked against the format's schema.
set -eu
folder=${1:?give the folder to write to}
cd "$(dirname "$0")/.."
[ -x .venv/bin/cyclonedx-py ] || .venv/bin/python -m pip install --quiet cyclonedx-bom
mkdir -p "$folder"
for image in api worker; do
    .venv/bin/cyclonedx-py requirements "deploy/images/$image.lock" --pyproject pyproject.toml --output-format JSON --validate --output-file "$folder/$image.cdx.json"
done
