"""A mouth, a slab and an object written for other programs: every part by its name, at its size, with its numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.assets.blender.shipped.bodies import Asset as BlenderAsset
from services.assets.exporters import export_to
from services.core.errors import InputError, ReadOnlyStoreError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.results import AssetManifest
from services.core.slab.folder import Cell
from services.core.store import StageWriter
from services.slab.results.tabphase import SCENE
from tests.support.command_line import dentine
from tests.support.prepared import sphere
from tests.unit.test_exporters import array, published
from tests.unit.test_usd_export import prim, value

NAMES = ("tooth_11_enamel", "tooth_11_dentin", "tooth_21_enamel", "gums", "cavity")
WALL = Mesh(np.array([[-7.0, -8, -5], [12, -8, -5], [12, -8, 5], [-7, -8, 5]]), np.array([[0, 1, 2], [0, 2, 3]]))
SHIFT_MM = np.array([9.0, 0.5, 1.0])


def estimate(number: float, unit: str = "1") -> dict[str, object]:
    return {"value": number, "se": number / 10, "unit": unit, "determined": True}


def published_mouth(root: Path) -> Path:
    """A job's folder with the asset of two teeth, gums and a wall."""
    writer, ball = StageWriter(root, "asset", 1), sphere(4.0)
    for path, mesh in {
        "teeth/11/outer.ply": ball,
        "teeth/11/dentin.ply": sphere(3.0),
        "teeth/21/outer.ply": Mesh(ball.vertices_mm + SHIFT_MM, ball.faces),
        "gums.ply": Mesh(ball.vertices_mm * [2, 1.2, 0.5] - [0, 0, 4], ball.faces),
        "cavity.ply": Mesh(WALL.vertices_mm, WALL.faces.astype(np.int32)),
    }.items():
        write_mesh(writer.folder / path, mesh)
    media = ("11.enamel", "11.dentin", "21.enamel", "gums")
    tables = {
        channel: {
            f"{part}.{name}": estimate(number + 0.1 * k, unit)
            for k, part in enumerate(media)
            for name, number, unit in (("sigma", 4.0, "1/mm"), ("alpha", 0.6, "1"), ("g1", 0.5, "1"))
        }
        | {"cavity.reflectance": estimate(0.3)}
        for channel in ("red", "green", "blue")
    }
    (writer.folder / "parameters.json").write_text(json.dumps(tables))
    (writer.folder / "rig.json").write_text(json.dumps({"views": {}, "ior": 1.5}))
    writer.publish(AssetManifest(files=()))
    return root


def published_slab(root: Path) -> Path:
    """A job's folder with the asset of a slab of 2 mm at two wavelengths."""
    writer, cell = StageWriter(root, "asset", 1), Cell(width_mm=2.0, index=1.33)
    numbers = {"sigma_t": 5.0, "sigma_s": 4.5, "sigma_a": 0.5, "sigma_s_reduced": 1.8, "g": 0.6, "index": 1.33}
    tables = {
        name: {key: estimate(number, "1" if key in {"g", "index"} else "1/mm") for key, number in numbers.items()}
        for name in ("520", "650.5")
    }
    for name in tables:
        scene = SCENE.format(
            width_mm=cell.width_mm, wavelength_nm=float(name), distance_mm=40, edge_mm=10, half_mm=1, bsdf="",
            sigma_t=5.0, albedo=0.9, values="1, 1",
        )  # fmt: skip
        (writer.folder / f"slab_{name}.xml").write_text(scene)
    (root / "parameters.json").write_text(json.dumps(tables))
    writer.publish(AssetManifest(files=()))
    return root


def test_a_mouth_has_all_its_parts_in_every_format(tmp_path: Path) -> None:
    gltf, usd, blender = export_to(published_mouth(tmp_path), ("gltf", "usd", "blender"))
    document, text = json.loads((gltf / "asset.gltf").read_text()), (usd / "asset.usda").read_text()
    assert tuple(node["name"] for node in document["nodes"]) == NAMES
    for k, name in enumerate(NAMES):
        mesh, primitive = prim(text, "Mesh", name), document["meshes"][k]["primitives"][0]
        points = value(mesh, "points")
        in_gltf = array(gltf, document, primitive["attributes"]["POSITION"], "<f4", 3)
        # (x, y, z) with z upwards is (x, z, -y) with y upwards.
        np.testing.assert_allclose(1000 * in_gltf[:, [0, 2, 1]] * [1, -1, 1], points, rtol=1e-6, atol=1e-5)
        assert document["materials"][k]["name"] == name
    assert value(prim(text, "Mesh", "tooth_21_enamel"), "points").mean(axis=0)[0] == pytest.approx(9, abs=0.5)
    # The wall only reflects, and has no highlight.
    wall, material = prim(text, "Material", "cavity"), document["materials"][NAMES.index("cavity")]
    assert material["pbrMetallicRoughness"]["baseColorFactor"] == [0.3, 0.3, 0.3, 1.0]
    assert "extensions" not in material
    assert value(wall, "inputs:specular_weight") == 0
    assert "subsurface" not in wall
    np.testing.assert_allclose(value(prim(text, "Mesh", "cavity"), "userProperties:reflectance"), [0.3] * 3, rtol=1e-8)
    np.testing.assert_allclose(value(prim(text, "Mesh", "gums"), "userProperties:sigma_per_mm"), [4.3] * 3, rtol=1e-8)
    # Enamel has the asset's index of refraction, gums their own.
    indices = [value(prim(text, "Material", name), "inputs:ior") for name in ("tooth_21_enamel", "gums")]
    np.testing.assert_allclose(indices, [1.5, 1.33])
    # Of two teeth, the one with dentin has textures.
    said = json.loads((usd / "textures/textures.json").read_text())
    assert list(said) == ["tooth_11_enamel"]
    assert (blender / "gums.ply").is_file()
    assert (blender / "cavity.ply").is_file()


def test_a_slab_is_a_plate_with_its_wavelengths(tmp_path: Path) -> None:
    gltf, usd = export_to(published_slab(tmp_path), ("gltf", "usd"))
    text, document = (usd / "asset.usda").read_text(), json.loads((gltf / "asset.gltf").read_text())
    mesh = prim(text, "Mesh", "slab")
    np.testing.assert_allclose(np.ptp(value(mesh, "points"), axis=0), [20, 20, 2], rtol=1e-6)
    # Edges are sharp: each normal is along an axis.
    np.testing.assert_allclose(np.abs(value(mesh, "normals")).max(axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(value(mesh, "userProperties:sigma_s_reduced_per_mm"), [1.8] * 3, rtol=1e-8)
    np.testing.assert_allclose(value(mesh, "userProperties:alpha"), [0.9] * 3, rtol=1e-8)
    shader = prim(prim(text, "Material", "slab"), "Shader", "open_pbr")
    assert value(shader, "inputs:subsurface_radius") == pytest.approx(1 / 2.3, rel=1e-8)
    assert value(shader, "inputs:specular_ior") == pytest.approx(1.33, rel=1e-8)
    said = document["scenes"][0]["extras"]["colours"]
    assert said == "All grey: the mean over the channels 520, 650.5, which are not red, green and blue."
    with pytest.raises(InputError, match="builds teeth and objects; export a slab with --to usd or gltf"):
        export_to(tmp_path, ("blender",))
    assert not [path.name for path in tmp_path.iterdir() if "blender" in path.name]


def published_object(root: Path) -> Path:
    """A job's folder with the asset of a ball with a core."""
    writer = StageWriter(root, "asset", 1)
    write_mesh(writer.folder / "object" / "outer.ply", sphere(4.0))
    write_mesh(writer.folder / "object" / "core.ply", sphere(3.0))
    names = (("sigma", 4.0, "1/mm"), ("alpha", 0.6, "1"), ("g1", 0.5, "1"))
    tables = {
        channel: {
            f"{part}.{name}": estimate(number * k, unit)
            for part, k in (("body", 1.0), ("core", 1.5))
            for name, number, unit in names
        }
        for channel in ("red", "green", "blue")
    }
    (writer.folder / "parameters.json").write_text(json.dumps(tables))
    rig = {"views": {}, "ior": 1.5, "boundary": "matched", "channels": ["red", "green", "blue"]}
    (writer.folder / "rig.json").write_text(json.dumps(rig))
    writer.publish(AssetManifest(files=()))
    return root


def test_an_object_has_its_body_and_core_in_every_format(tmp_path: Path) -> None:
    gltf, usd, blender = export_to(published_object(tmp_path), ("gltf", "usd", "blender"))
    document, text = json.loads((gltf / "asset.gltf").read_text()), (usd / "asset.usda").read_text()
    assert [node["name"] for node in document["nodes"]] == ["object_body", "object_core"]
    for name, number, width_mm in (("object_body", 4.0, 8.0), ("object_core", 6.0, 6.0)):
        mesh = prim(text, "Mesh", name)
        np.testing.assert_allclose(np.ptp(value(mesh, "points"), axis=0), width_mm, rtol=0.02)
        np.testing.assert_allclose(value(mesh, "userProperties:sigma_per_mm"), [number] * 3, rtol=1e-8)
    # The body's mean free path is the core's: sigma (1 - alpha) + sigma alpha (1 - g1), with 6, 0.9 and 0.75.
    shader = prim(prim(text, "Material", "object_body"), "Shader", "open_pbr")
    assert value(shader, "inputs:subsurface_radius") == pytest.approx(1 / (0.6 + 6 * 0.9 * 0.25), rel=1e-6)
    asset = BlenderAsset(blender)
    core, body = asset.bodies()
    assert (core.name, body.name, len(body.sides)) == ("object_core", "object_body", 2)
    np.testing.assert_allclose(core.medium.absorption, 0.6, rtol=1e-9)
    assert [solid.name for solid in asset.solids()] == ["object"]


def test_a_disk_that_cannot_be_written_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = published(tmp_path)
    # Root may write where permissions forbid it, so the system's answer is given here.
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(InputError, match=r"cannot be written, as .* takes no new file"):
        export_to(root, ("usd",))
    monkeypatch.undo()

    def refuse(path: Path) -> None:
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(ReadOnlyStoreError, match="The store is read-only at"):
        export_to(root, ("usd",))


def test_the_command_answers_an_unknown_exporter_with_a_sentence(tmp_path: Path) -> None:
    done = dentine("export", str(published(tmp_path)), "--to", "obj")
    assert done.returncode != 0
    (line,) = done.stderr.strip().splitlines()
    assert "Exporter 'obj' is not known; known are blender, gltf, usd" in line
