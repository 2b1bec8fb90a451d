"""Khronos' validator accepts the glTF files, and notices broken ones."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from services.assets.exporters import export_to
from tests.support.clients import node_command
from tests.unit.test_exporters import published
from tests.unit.test_mouth_and_slab_exports import published_object

SCRIPT = Path(__file__).parent / "gltf_findings.js"
INFORMATION = 2
"""Severity from which on a finding is no error and no warning."""
Json = dict[str, Any]


def findings(path: Path) -> list[Json]:
    """What the validator finds in a file."""
    command, environment = node_command()
    done = subprocess.run([*command, SCRIPT, path], check=True, capture_output=True, text=True, env=environment)
    found: list[Json] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (written,) = export_to(published(tmp_path_factory.mktemp("job")), ("gltf",))
    return written


def test_the_validator_finds_nothing(folder: Path) -> None:
    assert [one for one in findings(folder / "asset.gltf") if one["severity"] < INFORMATION] == []


def test_the_validator_finds_nothing_in_an_object(tmp_path: Path) -> None:
    (written,) = export_to(published_object(tmp_path), ("gltf",))
    assert [one for one in findings(written / "asset.gltf") if one["severity"] < INFORMATION] == []


def wrong_bounds(document: Json) -> None:
    document["accessors"][0]["max"][0] += 1.0


def wrong_colour(document: Json) -> None:
    document["materials"][1]["pbrMetallicRoughness"]["baseColorFactor"][0] = 1.5


def wrong_index(document: Json) -> None:
    document["materials"][0]["extensions"]["KHR_materials_ior"]["ior"] = 0.5


def absent_picture(document: Json) -> None:
    document["images"][0]["uri"] = "textures/absent.png"


def long_normals(document: Json) -> None:
    # Places in metres are taken for normals.
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    attributes["NORMAL"] = attributes["POSITION"]


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (wrong_bounds, "ACCESSOR_MAX_MISMATCH"),
        (wrong_colour, "VALUE_NOT_IN_RANGE"),
        (wrong_index, "VALUE_NOT_IN_RANGE"),
        (absent_picture, "IO_ERROR"),
        (long_normals, "ACCESSOR_VECTOR3_NON_UNIT"),
    ],
)
def test_the_validator_notices_a_broken_file(folder: Path, spoil: Callable[[Json], None], code: str) -> None:
    document = json.loads((folder / "asset.gltf").read_text())
    spoil(document)
    broken = folder / "broken.gltf"
    broken.write_text(json.dumps(document))
    assert code in {one["code"] for one in findings(broken)}
