"""A published asset is written for other programs: with normals, texture coordinates, names, scale and coefficients."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from services.assets.exporters import export_to
from services.core.errors import CorruptStoreError, InputError, MeshError, SettingsError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.results import AssetManifest
from services.core.store import StageWriter
from tests.support.command_line import dentine
from tests.support.prepared import sphere

COEFFICIENTS = {
    "red": {"sigma": 4.0, "alpha": 0.99, "g1": 0.7},
    "green": {"sigma": 5.0, "alpha": 0.98, "g1": 0.7},
    "blue": {"sigma": 6.0, "alpha": 0.96, "g1": 0.7},
}


def published(
    root: Path,
    outer: Mesh | None = None,
    rig: dict[str, object] | None = None,
    dentin: Mesh | None = None,
    before: Callable[[StageWriter], None] | None = None,
) -> Path:
    """A job's folder with the asset of a tooth; of two spheres unless its surfaces are given.

    Args:
        before: adds to the asset before it is published.
    """
    writer = StageWriter(root, "asset", 1)
    write_mesh(writer.folder / "teeth/11/outer.ply", outer or sphere(4.0))
    write_mesh(writer.folder / "teeth/11/dentin.ply", dentin or sphere(3.0))
    tables = {
        channel: {
            f"{part}.{name}": {
                "value": value,
                "se": value / 8,
                "unit": "1/mm" if name == "sigma" else "1",
                "determined": True,
            }
            for part in ("enamel", "dentin")
            for name, value in own.items()
        }
        for channel, own in COEFFICIENTS.items()
    }
    (writer.folder / "parameters.json").write_text(json.dumps(tables))
    if rig is not None:
        (writer.folder / "rig.json").write_text(json.dumps(rig))
    if before is not None:
        before(writer)
    writer.publish(AssetManifest(files=()))
    return root


def array(folder: Path, document: dict[str, object], index: int, kind: str, columns: int) -> np.ndarray:
    view = document["bufferViews"][document["accessors"][index]["bufferView"]]  # type: ignore[index]
    stored = (folder / "asset.bin").read_bytes()[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(stored, kind).reshape(-1, columns)


def test_gltf_keeps_names_scale_normals_and_coefficients(tmp_path: Path) -> None:
    (folder,) = export_to(published(tmp_path), ("gltf",))
    document = json.loads((folder / "asset.gltf").read_text())
    assert [node["name"] for node in document["nodes"]] == ["tooth_11_enamel", "tooth_11_dentin"]
    primitive = document["meshes"][0]["primitives"][0]
    points = array(folder, document, primitive["attributes"]["POSITION"], "<f4", 3)
    np.testing.assert_allclose(
        np.ptp(points, axis=0).max(), np.ptp(sphere(4.0).vertices_mm, axis=0).max() / 1000, rtol=1e-6
    )
    normals = array(folder, document, primitive["attributes"]["NORMAL"], "<f4", 3)
    centre = points - sphere(4.0).vertices_mm.mean(axis=0) / 1000
    cosines = np.einsum("ij,ij->i", normals, centre / np.linalg.norm(centre, axis=1, keepdims=True))
    assert cosines.min() > 0.99  # of a sphere, the normals are radial
    told = document["materials"][1]["extras"]["coefficients"]
    assert {c: {n: told[c][n]["value"] for n in own} for c, own in COEFFICIENTS.items()} == COEFFICIENTS
    assert told["red"]["sigma"]["se"] == 0.5
    said = document["asset"]["extras"]
    assert "light from behind are lost" in said["lost"]
    assert document["scenes"][0]["extras"] == said
    assert said["colours"].startswith("The camera's red, green and blue are taken for linear RGB")
    volume = document["materials"][1]["extensions"]["KHR_materials_volume"]
    absorption = -np.log(volume["attenuationColor"]) / (1000 * volume["attenuationDistance"])
    np.testing.assert_allclose(absorption, [(1 - t["alpha"]) * t["sigma"] for t in COEFFICIENTS.values()], rtol=1e-9)


def test_texture_coordinates_do_not_overlap(tmp_path: Path) -> None:
    (folder,) = export_to(published(tmp_path), ("gltf",))
    document = json.loads((folder / "asset.gltf").read_text())
    primitive = document["meshes"][0]["primitives"][0]
    uv = array(folder, document, primitive["attributes"]["TEXCOORD_0"], "<f4", 2).astype(float)
    faces = array(folder, document, primitive["indices"], "<u4", 3)
    corners = uv[faces]
    x, y = np.random.default_rng(0).uniform(size=(2, 400, 1))
    sides = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        sides.append((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0]))
    signs = np.stack(sides)
    covering = ((signs > 1e-9).all(axis=0) | (signs < -1e-9).all(axis=0)).sum(axis=1)
    assert covering.max() == 1
    assert covering.mean() > 0.3  # most of the texture is used


def test_bad_input_is_one_sentence_each(tmp_path: Path) -> None:
    root = published(tmp_path / "job")
    with pytest.raises(SettingsError, match="Exporter 'obj' is not known; known are"):
        export_to(root, ("obj",))
    whole = sphere(4.0)
    with pytest.raises(MeshError, match="not watertight"):
        export_to(published(tmp_path / "open", Mesh(whole.vertices_mm, whole.faces[1:])), ("gltf",))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        export_to(tmp_path / "file", ("gltf",))
    (root / "asset/parameters.json").write_text("{}")
    with pytest.raises(CorruptStoreError, match=r"parameters\.json of published stage asset"):
        export_to(root, ("gltf",))
    assert not (root / "asset-gltf").exists()


def test_the_command_writes_again_in_place_of_an_earlier_export(tmp_path: Path) -> None:
    root = published(tmp_path)
    (root / "asset-gltf").mkdir()
    (root / "asset-gltf/old").write_text("")
    done = dentine("export", str(root), "--to", "gltf")
    assert done.returncode == 0, done.stderr
    written = sorted(p.name for p in (root / "asset-gltf").iterdir())
    assert written == ["asset.bin", "asset.gltf", "manifest.json", "textures"]
    assert not [p for p in root.iterdir() if p.name.startswith(".asset-gltf")]


def test_blender_gets_surfaces_numbers_and_scripts(tmp_path: Path) -> None:
    (folder,) = export_to(published(tmp_path, rig={"views": {}}), ("blender",))
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {file for file in files if not file.startswith("textures/")} == {
        "parameters.json", "rig.json", "teeth/11/outer.ply", "teeth/11/dentin.ply", "blender/blender_scene.py",
        "blender/bodies.py", "blender/materials.py", "manifest.json",
    }  # fmt: skip


def test_an_asset_without_cameras_is_to_be_written_again_for_blender(tmp_path: Path) -> None:
    with pytest.raises(CorruptStoreError, match="describes no cameras; write the asset again with dentine export"):
        export_to(published(tmp_path, rig={"cameras": ["c0"]}), ("blender",))
    assert not (tmp_path / "asset-blender").exists()
