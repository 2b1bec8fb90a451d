"""Khronos' validator accepts the glTF files, where the npm package gltf-validator is on NODE_PATH."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from services.assets.exporters import export_to
from tests.unit.test_exporters import published

SCRIPT = """
const fs = require('fs'), path = require('path'), validator = require('gltf-validator');
const file = process.argv[1];
const read = uri => Promise.resolve(new Uint8Array(fs.readFileSync(path.join(path.dirname(file), uri))));
validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {externalResourceFunction: read})
  .then(report => console.log(JSON.stringify(report.issues)));
"""


def issues(path: Path) -> list[dict[str, Any]]:
    """What the validator finds in a file."""
    node = shutil.which("node")
    if (
        node is None
        or subprocess.run([node, "-e", "require('gltf-validator')"], check=False, capture_output=True).returncode
    ):
        pytest.skip("node with the npm package gltf-validator on NODE_PATH is not installed")
    done = subprocess.run([node, "-e", SCRIPT, str(path)], check=True, capture_output=True, text=True)
    return json.loads(done.stdout)["messages"]


def test_the_validator_finds_nothing_and_notices_a_broken_file(tmp_path: Path) -> None:
    (folder,) = export_to(published(tmp_path), ("gltf",))
    path = folder / "asset.gltf"
    assert [one for one in issues(path) if one["severity"] < 2] == []
    document = json.loads(path.read_text())
    document["accessors"][0]["max"][0] += 1.0
    path.write_text(json.dumps(document))
    assert "ACCESSOR_MAX_MISMATCH" in {one["code"] for one in issues(path)}
