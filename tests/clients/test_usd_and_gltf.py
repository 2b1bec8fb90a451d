"""Blender imports the USD and glTF files of an asset, and the formats' own validators find nothing wrong in them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from services.assets.exporters import export_to
from services.core.geometry import Mesh
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.parameters import Medium
from tests.support.clients import client_python, run_client
from tests.support.prepared import camera, sphere
from tests.unit.test_exporters import COEFFICIENTS, published
from tests.unit.test_mouth_and_slab_exports import WALL, published_mouth, published_object, published_slab

HERE = Path(__file__).parent
FILES = {"usd": "asset.usda", "gltf": "asset.gltf"}
UNKNOWN_SHADER = "MissingShaderIdInRegistry"
"""The one finding that is expected: ``usd-core`` brings no definitions of MaterialX's shaders, ``ND_...``."""
Facts = dict[str, Any]
SEMI_AXES_MM = np.array([3.0, 2.5, 4.5])
CENTRE_MM = np.array([0.5, -1.0, 7.0])
"""Three unequal lengths and a place, so that a turned or mirrored axis is seen."""

RIG = {
    "boundary": "matched", "ior": 1.631, "channels": list(COEFFICIENTS), "cameras": ["c0"],
    "views": {"c0": camera("c0").model_dump(exclude={"name"})},
    "lights": {"l0": {"position_mm": [0, 500, 100], "intensity": [1e6] * 3}},
}  # fmt: skip


def ellipsoid(share: float) -> Mesh:
    ball = sphere(1.0)
    return Mesh(share * SEMI_AXES_MM * ball.vertices_mm + CENTRE_MM, ball.faces)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = published(tmp_path_factory.mktemp("job"), ellipsoid(1.0), RIG, ellipsoid(0.75))
    export_to(root, (*FILES, "blender"))
    return root


def imported(path: Path) -> Facts:
    done = run_client("bpy", HERE / "import_facts.py", path)
    assert done.returncode == 0, done.stderr
    found: Facts = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def findings(module: str, path: Path) -> list[list[str]]:
    done = run_client(module, HERE / "usd_findings.py", path)
    assert done.returncode == 0, done.stderr
    found: list[list[str]] = json.loads(done.stdout.strip().splitlines()[-1])
    return [one for one in found if not (one[1] == UNKNOWN_SHADER and "shaderId 'ND_" in one[2])]


@pytest.fixture(scope="module", params=FILES)
def facts(request: pytest.FixtureRequest, job: Path) -> tuple[str, Facts]:
    client_python("bpy")
    return request.param, imported(job / f"asset-{request.param}" / FILES[request.param])


def require_like(found: Facts, expected: Mesh) -> None:
    """The surface at its size and place, with z upwards, smooth normals, and texture coordinates within 0 to 1."""
    points = 1000 * np.array(found["metres"])
    np.testing.assert_allclose(np.ptp(points, axis=0), np.ptp(expected.vertices_mm, axis=0), rtol=1e-3)
    np.testing.assert_allclose(points.min(axis=0), expected.vertices_mm.min(axis=0), atol=1e-3)
    outwards = (points[np.array(found["corner_vertex"])] - CENTRE_MM) / SEMI_AXES_MM**2
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    # Faces of some 0.3 rad turn a vertex's normal by a small part of that; flat shading would give 0.96 and less.
    assert np.einsum("ij,ij->i", np.array(found["corner_normals"]), outwards).min() > 0.99
    uv = np.array(found["corner_uv"])
    assert uv.min() >= 0
    assert uv.max() <= 1
    assert np.ptp(uv, axis=0).min() > 0.3
    assert found["smooth"]


def test_blender_gets_names_sizes_normals_and_texture_coordinates(facts: tuple[str, Facts]) -> None:
    meshes = facts[1]["meshes"]
    assert set(meshes) == {"tooth_11_enamel", "tooth_11_dentin"}
    for name, share in (("tooth_11_enamel", 1.0), ("tooth_11_dentin", 0.75)):
        require_like(meshes[name], ellipsoid(share))
        assert meshes[name]["material"] == name
        assert meshes[name]["inputs"]["Roughness"] == pytest.approx(0.35, rel=1e-6)
        assert meshes[name]["inputs"]["IOR"] == pytest.approx(1.631, rel=1e-6)


def test_blender_gets_the_pictures_of_the_colour(facts: tuple[str, Facts], job: Path) -> None:
    name, found = facts
    folder = job / f"asset-{name}" / "textures"
    told = json.loads((folder / "textures.json").read_text())["tooth_11_enamel"]
    (image,) = found["images"]
    assert image.startswith("tooth_11_enamel_base_colour")
    assert found["images"][image] == told["size"]
    assert found["meshes"]["tooth_11_enamel"]["inputs"]["Base Color"] == image
    bytes_of = np.array(Image.open(folder / told["base_colour"]["png"]))
    # Blender's mean includes an opacity of 1.
    assert found["pixels"][image] == pytest.approx((3 * bytes_of.mean() / 255 + 1) / 4, rel=1e-5)
    # Dentin is of one colour.
    expected = [
        half_space_reflectance(Medium(own["sigma"], own["alpha"], g1=own["g1"])) for own in COEFFICIENTS.values()
    ]
    np.testing.assert_allclose(found["meshes"]["tooth_11_dentin"]["inputs"]["Base Color"][:3], expected, rtol=1e-6)


def test_blender_gets_the_coefficients(facts: tuple[str, Facts]) -> None:
    name, found = facts
    mesh = found["meshes"]["tooth_11_dentin"]
    for leaf in ("sigma", "alpha", "g1"):
        expected = np.array([own[leaf] for own in COEFFICIENTS.values()])
        if name == "usd":
            spelled = "sigma_per_mm" if leaf == "sigma" else leaf
            told = [mesh["properties"][spelled + ending] for ending in ("", "_se")]
        else:
            tables = mesh["material_properties"]["coefficients"]
            told = [[tables[channel][leaf][key] for channel in COEFFICIENTS] for key in ("value", "se")]
        np.testing.assert_allclose(told, [expected, expected / 8], rtol=1e-6)


@pytest.mark.parametrize("name", FILES)
def test_blender_gets_a_mouth_a_slab_and_an_object(name: str, tmp_path: Path) -> None:
    client_python("bpy")
    sizes_mm: dict[str, list[float]] = {
        "tooth_11_enamel": [8, 8, 8], "tooth_11_dentin": [6, 6, 6], "tooth_21_enamel": [8, 8, 8], "gums": [16, 9.6, 4],
        "cavity": [19, 0, 10],
    }  # fmt: skip
    export_to(published_mouth(tmp_path / "mouth"), (name,))
    meshes = imported(tmp_path / "mouth" / f"asset-{name}" / FILES[name])["meshes"]
    assert set(meshes) == set(sizes_mm)
    for part, size_mm in sizes_mm.items():
        found = np.ptp(1000 * np.array(meshes[part]["metres"]), axis=0)
        # The balls' facets reach their radius along the axes.
        np.testing.assert_allclose(found, size_mm, rtol=1e-3, atol=1e-4)
    wall = meshes["cavity"]
    np.testing.assert_allclose(wall["inputs"]["Base Color"][:3], [0.3] * 3, rtol=1e-6)
    np.testing.assert_allclose(1000 * np.array(wall["metres"])[:, 1], WALL.vertices_mm[0, 1], rtol=1e-5)
    export_to(published_slab(tmp_path / "slab"), (name,))
    (plate,) = imported(tmp_path / "slab" / f"asset-{name}" / FILES[name])["meshes"].values()
    np.testing.assert_allclose(np.ptp(1000 * np.array(plate["metres"]), axis=0), [20, 20, 2], rtol=1e-3)
    export_to(published_object(tmp_path / "object"), (name,))
    balls = imported(tmp_path / "object" / f"asset-{name}" / FILES[name])["meshes"]
    for part, width_mm in (("object_body", 8), ("object_core", 6)):
        np.testing.assert_allclose(np.ptp(1000 * np.array(balls[part]["metres"]), axis=0), width_mm, rtol=1e-3)


def test_the_script_for_blender_has_the_names_and_coordinates_of_the_textures(job: Path, tmp_path: Path) -> None:
    client_python("bpy")
    folder = job / "asset-blender"
    done = run_client("bpy", folder / "blender" / "blender_scene.py", "--save", tmp_path / "tooth.blend")
    assert done.returncode == 0, done.stderr
    done = run_client("bpy", HERE / "blender_facts.py", tmp_path / "tooth.blend")
    meshes = json.loads(done.stdout.strip().splitlines()[-1])["scenes"]["teeth"]["meshes"]
    assert set(meshes) == {"tooth_11_enamel", "tooth_11_dentin"}
    # The enamel's shell has faces of the outer surface, each with its place in the textures, and of the dentin's.
    low, high = meshes["tooth_11_enamel"]["uv_range"]
    assert 0 <= low[0] < 0.1
    assert 0.9 < high[0] <= 1


def test_the_validators_find_nothing_in_usd_and_materialx(job: Path) -> None:
    assert findings("pxr", job / "asset-usd/asset.usda") == []
    assert findings("MaterialX", job / "asset-usd/asset.mtlx") == []


@pytest.mark.parametrize("published_as", [published_object, published_mouth, published_slab])
def test_the_validators_find_nothing_in_an_object_a_mouth_and_a_slab(
    published_as: Callable[[Path], Path], tmp_path: Path
) -> None:
    (folder,) = export_to(published_as(tmp_path), ("usd",))
    assert findings("pxr", folder / "asset.usda") == []
    assert findings("MaterialX", folder / "asset.mtlx") == []


@pytest.mark.parametrize(
    ("module", "name", "old", "new", "finding"),
    [
        ("pxr", "asset.usda", "metersPerUnit = 0.001", "", "MissingMetersPerUnitMetadata"),
        ("pxr", "asset.usda", 'prepend apiSchemas = ["MaterialBindingAPI"]', "", "MissingMaterialBindingAPI"),
        ("pxr", "asset.usda", '"UsdPreviewSurface"', '"UsdPreviewSurfaces"', UNKNOWN_SHADER),
        ("MaterialX", "asset.mtlx", '"subsurface_radius"', '"subsurface_length"', "subsurface_length"),
        ("MaterialX", "asset.mtlx", 'type="float" value="0.35"', 'type="color3" value="1, 1, 1"', "type"),
    ],
)
def test_the_validators_notice_a_broken_file(
    module: str, name: str, old: str, new: str, finding: str, job: Path, tmp_path: Path
) -> None:
    client_python(module)
    text = (job / "asset-usd" / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new))
    assert finding in json.dumps(findings(module, tmp_path / name))
