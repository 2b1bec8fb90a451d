"""``dentine verify`` opens an asset by the programs that are installed, and each is shown to notice a broken file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from services.assets.exporters import export_to
from services.assets.verification.clients import check_gltf, check_materialx, check_mitsuba, check_usd
from services.assets.verification.verify import exported_folders, verify
from services.core.errors import MissingStageError
from services.core.provenance.hash_list import write_hash_list
from tests.support.clients import client_python
from tests.support.command_line import dentine
from tests.unit.test_export_colour import EQUAL, asset
from tests.unit.test_exporters import published


@pytest.mark.dear("Mitsuba starts and compiles in a process of its own, once for a scene that is whole and once for one"
                  " that is not")  # fmt: skip
def test_mitsuba_renders_a_scene_and_notices_a_broken_one(tmp_path: Path) -> None:
    asset(tmp_path, EQUAL[:1], ("green",))
    whole = check_mitsuba(tmp_path / "scene_green.xml", "")
    assert whole is not None
    assert whole.name.startswith("Mitsuba 3.")
    assert whole.findings == ()
    (tmp_path / "teeth" / "11" / "outer.ply").unlink()
    broken = check_mitsuba(tmp_path / "scene_green.xml", "")
    assert broken is not None
    assert "outer.ply" in broken.findings[0]


def test_the_gltf_validator_notices_a_broken_file(tmp_path: Path) -> None:
    (folder,) = export_to(published(tmp_path), ("gltf",))
    whole = check_gltf(folder / "asset.gltf", "")
    if whole is None:
        pytest.skip("node with the npm package gltf-validator on NODE_PATH is not installed")
    assert whole.findings == ()
    document = json.loads((folder / "asset.gltf").read_text())
    document["accessors"][0]["max"][0] += 1.0
    (folder / "asset.gltf").write_text(json.dumps(document))
    broken = check_gltf(folder / "asset.gltf", "")
    assert broken is not None
    assert "ACCESSOR_MAX_MISMATCH" in broken.findings[0]


def test_usd_and_materialx_notice_a_broken_file(tmp_path: Path) -> None:
    usd, materialx = str(client_python("pxr")), str(client_python("MaterialX"))
    file = tmp_path / "asset.usda"
    stage = """#usda 1.0
(
    defaultPrim = "tooth"
    metersPerUnit = 0.001
    upAxis = "Y"
)
def Xform "tooth"
{{
    def Material "m"
    {{
        token outputs:surface.connect = </tooth/m/s.outputs:surface>
        def Shader "s"
        {{
            uniform token info:id = "{}"
            token outputs:surface
        }}
    }}
}}
"""
    # Nodes of MaterialX are unknown to the package from the index, and are left to MaterialX's own check.
    file.write_text(stage.format("ND_open_pbr_surface_surfaceshader"))
    whole = check_usd(file, usd)
    assert whole is not None
    assert whole.findings == ()
    file.write_text(stage.format("NoSuchSurface"))
    broken = check_usd(file, usd)
    assert broken is not None
    assert any("NoSuchSurface" in finding for finding in broken.findings)
    file = tmp_path / "asset.mtlx"
    material = '<open_pbr_surface name="s" type="surfaceshader">{}</open_pbr_surface>'
    surface = f'<materialx version="1.39">{material}</materialx>'
    file.write_text(surface.format(""))
    whole = check_materialx(file, materialx)
    assert whole is not None
    assert whole.findings == ()
    file.write_text(surface.format('<input name="base_weight" type="integer" value="1" />'))
    broken = check_materialx(file, materialx)
    assert broken is not None
    assert broken.findings


def test_all_exports_of_a_job_are_checked_and_an_edit_is_one_sentence(tmp_path: Path) -> None:
    job = published(tmp_path)
    (folder,) = export_to(job, ("gltf",))
    assert [path.name for path in exported_folders(job)] == ["asset", "asset-gltf"]
    assert exported_folders(folder) == (folder,)
    assert [(one.what.split(",")[0], one.state) for one in verify(job / "asset")] == [("files as written", "passed")]
    (folder / "asset.bin").write_bytes(b"")
    done = dentine("verify", str(job))
    assert done.returncode == 3
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.endswith("asset.bin was edited since the asset was written; restore it, or write the asset again with"
                         " dentine export.")  # fmt: skip


def test_what_a_program_finds_is_printed_and_ends_with_its_own_status(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'><shape type='tooth'/></scene>")
    write_hash_list(tmp_path, "asset")
    done = dentine("verify", str(tmp_path), "--json")
    assert done.returncode == 3
    (files, scene) = json.loads(done.stdout)
    assert (files["state"], scene["state"]) == ("passed", "failed")
    assert "tooth" in scene["findings"][0]


def test_a_folder_without_an_asset_is_said(tmp_path: Path) -> None:
    with pytest.raises(MissingStageError, match="holds no exported asset"):
        exported_folders(tmp_path)
