"""A published asset as text of USD: names, millimetres, normals, texture coordinates, shaders and coefficients."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from services.assets.exporters import export_to
from services.assets.usd.text import quoted
from tests.support.prepared import sphere
from tests.unit.test_exporters import COEFFICIENTS, published


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (written,) = export_to(published(tmp_path_factory.mktemp("job")), ("usd",))
    return written


def prim(text: str, kind: str, name: str) -> str:
    """Lines from one prim to the end of its block."""
    start = re.search(rf'^( *)def {kind} "{name}"', text, re.MULTILINE)
    assert start is not None
    return text[start.start() : text.index(f"\n{start[1]}}}", start.start())]


def value(block: str, name: str) -> np.ndarray:
    found = re.search(rf" {re.escape(name)} = ([^=]*?)(?: \(inter.*)?$", block, re.MULTILINE)
    assert found is not None, name
    return np.array(ast.literal_eval(found[1]))


def test_usd_keeps_names_scale_normals_and_coefficients(folder: Path) -> None:
    text = (folder / "asset.usda").read_text()
    assert "metersPerUnit = 0.001" in text
    assert re.findall(r'def Mesh "(\w+)"', text) == ["tooth_11_enamel", "tooth_11_dentin"]
    mesh = prim(text, "Mesh", "tooth_11_enamel")
    points, normals = value(mesh, "points"), value(mesh, "normals")
    # Nine digits hold the single precision of the surface's file.
    np.testing.assert_allclose(np.ptp(points, axis=0), np.ptp(sphere(4.0).vertices_mm, axis=0), rtol=1e-7)
    np.testing.assert_allclose(value(mesh, "extent"), [points.min(axis=0), points.max(axis=0)])
    # The normals of a sphere are radial.
    assert np.einsum("ij,ij->i", normals, points / 4.0).min() > 0.99
    for name in ("sigma", "alpha", "g1"):
        spelled = "sigma_per_mm" if name == "sigma" else name
        expected = [own[name] for own in COEFFICIENTS.values()]
        np.testing.assert_allclose(value(mesh, f"userProperties:{spelled}"), expected, rtol=1e-8)
        np.testing.assert_allclose(value(mesh, f"userProperties:{spelled}_se"), np.array(expected) / 8, rtol=1e-8)
    # The second lobe is absent, and said to be.
    np.testing.assert_array_equal(value(mesh, "userProperties:beta"), [1, 1, 1])
    assert "userProperties:beta_se" not in mesh
    assert "light from behind are lost" in text


def test_the_shaders_say_the_mean_free_paths_of_the_dentin(folder: Path) -> None:
    text = (folder / "asset.usda").read_text()
    shader = prim(prim(text, "Material", "tooth_11_enamel"), "Shader", "open_pbr")
    total = [own["sigma"] * (own["alpha"] * (1 - own["g1"]) + 1 - own["alpha"]) for own in COEFFICIENTS.values()]
    radius, scale = value(shader, "inputs:subsurface_radius"), value(shader, "inputs:subsurface_radius_scale")
    np.testing.assert_allclose(radius * scale, 1 / np.array(total), rtol=1e-8)
    assert scale.max() == 1.0
    document = ElementTree.parse(folder / "asset.mtlx").getroot()
    surface = document.find("open_pbr_surface[@name='tooth_11_enamel_surface']")
    assert surface is not None
    inputs = {one.attrib["name"]: one.attrib.get("value") for one in surface}
    assert set(inputs) == set(re.findall(r"inputs:(\w+)", shader))
    for name, told in inputs.items():
        if told is not None:
            np.testing.assert_array_equal(np.array(ast.literal_eval(told)), value(shader, f"inputs:{name}"))


def test_the_colour_of_enamel_is_a_picture_in_every_shader(folder: Path) -> None:
    text = (folder / "asset.usda").read_text()
    enamel, dentin = (prim(text, "Material", f"tooth_11_{tissue}") for tissue in ("enamel", "dentin"))
    file = "textures/tooth_11_enamel_base_colour.png"
    assert (folder / file).is_file()
    assert enamel.count(f"inputs:file = @{file}@") == 2
    path = "</asset/materials/tooth_11_enamel/"
    assert f"inputs:diffuseColor.connect = {path}picture.outputs:rgb>" in enamel
    for name in ("base_color", "subsurface_color"):
        assert f"inputs:{name}.connect = {path}open_pbr_picture.outputs:out>" in enamel
    assert "picture" not in dentin
    document = ElementTree.parse(folder / "asset.mtlx").getroot()
    (picture,) = document.findall(".//input[@type='filename']")
    assert picture.attrib == {"name": "file", "type": "filename", "value": file, "colorspace": "srgb_texture"}


def test_quotes_and_line_ends_stay_within_a_string() -> None:
    assert quoted('a "b"\n\\ ±') == r'"a \"b\"\n\\ ±"'
