"""The bodies that Blender fills with media are closed, do not touch, and carry the asset's numbers."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from services.assets.blender.scripts import SHIPPED, write_scripts
from services.assets.mitsuba.dielectric import ABSORPTION, ROUGHNESS, as_dielectric
from services.assets.mitsuba.mouth_scene import write_mouth_surfaces
from services.assets.mitsuba.scene import medium_dict
from services.core.files.meshes import read_mesh, write_mapped_mesh, write_mesh
from services.core.geometry import Mesh, Tooth
from services.transport.optics.parameters import Medium
from tests.support.small_mouth import CORE, FREE, GUMS_IOR, IOR, ROOTED, gums, wall
from tests.support.small_tooth import ellipsoid, sphere

READER = SimpleNamespace(**runpy.run_path(str(SHIPPED / "bodies.py")))


def write_numbers(folder: Path, boundary: str, tables: dict[str, dict[str, float]]) -> None:
    rig = {
        "boundary": boundary,
        "ior": IOR,
        "channels": list(tables),
        "cameras": [],
        "lights": {"l0": {"position_mm": [0, 0, 100], "intensity": [float(k + 1) for k in range(len(tables))]}},
    }
    (folder / "rig.json").write_text(json.dumps(rig))
    parameters = {c: {name: {"value": value} for name, value in table.items()} for c, table in tables.items()}
    (folder / "parameters.json").write_text(json.dumps(parameters))


def write_tooth(folder: Path, boundary: str = "matched") -> None:
    write_mesh(folder / "teeth/11/outer.ply", sphere(3.0))
    write_mesh(folder / "teeth/11/dentin.ply", sphere(2.0))
    table = {"enamel.sigma": 2.0, "enamel.alpha": 0.9, "enamel.beta": 0.8, "enamel.g1": 0.6, "enamel.g2": -0.5}
    table |= {"dentin.sigma": 5.0, "dentin.alpha": 0.8}
    write_numbers(folder, boundary, {"red": table, "green": table | {"enamel.sigma": 3.0}})


def closed(body: SimpleNamespace) -> Mesh:
    surface = body.surface()
    return Mesh(surface.vertices, surface.faces.astype(np.int32))


def test_a_surface_is_read_as_it_was_written(tmp_path: Path) -> None:
    ball = sphere(3.0)
    uv = np.random.default_rng(1).uniform(size=(len(ball.faces), 3, 2))
    write_mapped_mesh(tmp_path / "ball.ply", ball, uv)
    found = READER.read_ply(tmp_path / "ball.ply")
    corners = found.vertices[found.faces]
    np.testing.assert_array_equal(corners, ball.vertices_mm.astype(np.float32)[ball.faces])
    # The vertices on seams are one again, and the first row of texels, at v = 0, is the top one.
    assert len(found.vertices) == len(ball.vertices_mm)
    np.testing.assert_allclose(found.corners_uv, np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1), atol=1e-7)


def test_a_tooth_is_a_core_in_a_shell(tmp_path: Path) -> None:
    write_tooth(tmp_path)
    asset = READER.Asset(tmp_path)
    dentin, enamel = asset.bodies()
    outer, core = (read_mesh(tmp_path / f"teeth/11/{name}.ply") for name in ("outer", "dentin"))
    assert closed(enamel).signed_volume_mm3() == pytest.approx(
        outer.signed_volume_mm3() - core.signed_volume_mm3(), rel=1e-6
    )
    closed(enamel).require_solid("enamel")
    assert (dentin.moved, enamel.moved) == (True, False)
    moved = dentin.surface().moved_inwards(1e-4)
    # A ball's vertex normals are its radii to a part in a thousand, so that each vertex moves straight inwards.
    np.testing.assert_allclose(np.linalg.norm(moved.vertices, axis=1), 2.0 - 1e-4, atol=1e-6)


def test_numbers_are_the_assets(tmp_path: Path) -> None:
    write_tooth(tmp_path)
    asset = READER.Asset(tmp_path)
    # Two channels: the last one stands for the third.
    assert asset.channels == ["red", "green", "green"]
    enamel = asset.medium("enamel")
    np.testing.assert_allclose(enamel.absorption, 0.1 * np.array([2.0, 3.0, 3.0]))
    (first, g1), (second, g2) = enamel.lobes
    np.testing.assert_allclose(first, 0.8 * 0.9 * np.array([2.0, 3.0, 3.0]))
    np.testing.assert_allclose(second, 0.2 * 0.9 * np.array([2.0, 3.0, 3.0]))
    assert (g1[0], g2[0]) == (0.6, -0.5)
    assert len(asset.medium("dentin").lobes) == 1
    np.testing.assert_array_equal(asset.intensity("l0"), [1.0, 2.0, 2.0])
    assert asset.one_phase
    assert READER.Asset(tmp_path, ["green"]).channels == ["green"] * 3


def test_glass_of_a_thin_boundary_is_that_of_the_dielectric_scene(tmp_path: Path) -> None:
    write_tooth(tmp_path, "thin")
    asset = READER.Asset(tmp_path)
    assert (READER.THIN_ABSORPTION, READER.THIN_ALPHA) == (ABSORPTION, ROUGHNESS)
    # Mitsuba's facets are Beckmann's unless told otherwise; Cycles' roughness is the root of their width.
    assert asset.finish("glass", None) == ("glass", pytest.approx(ROUGHNESS**0.5), "BECKMANN")
    assert asset.finish("glass", 0.0) == ("glass", 0.0, "BECKMANN")
    assert asset.finish("asset", None) == ("asset", 0.0, "GGX")
    assert (asset.as_glass("glass"), asset.as_glass("asset")) == (True, False)
    fitted = asset.medium("enamel")
    converted, own = fitted.absorbing(ABSORPTION), medium_dict(Medium(2.0, 0.9, 0.8, 0.6, -0.5))
    scene = as_dielectric({"medium_enamel": own})["medium_enamel"]
    assert converted.sigma[0] == pytest.approx(scene["sigma_t"])
    assert converted.alpha[0] == pytest.approx(scene["albedo"])
    empty = READER.Medium(*np.zeros((5, 3))).absorbing(ABSORPTION)
    assert not empty.sigma.any()
    assert not empty.alpha.any()


def test_other_cosines_in_a_channel_are_seen(tmp_path: Path) -> None:
    write_tooth(tmp_path)
    path = tmp_path / "parameters.json"
    tables = json.loads(path.read_text())
    tables["green"]["enamel.g1"]["value"] = 0.61
    path.write_text(json.dumps(tables))
    assert not READER.Asset(tmp_path).one_phase


def test_only_a_surface_in_air_has_a_contrast(tmp_path: Path) -> None:
    write_tooth(tmp_path, "thin")
    _, enamel = READER.Asset(tmp_path).bodies()
    assert [(side.ior, side.outside) for side in enamel.sides] == [(IOR, True), (1.0, False)]
    (solid,) = READER.Asset(tmp_path).solids()
    assert solid.medium.sigma[0] == 5.0
    assert closed(solid).signed_volume_mm3() == pytest.approx(sphere(3.0).signed_volume_mm3(), rel=1e-6)


def test_bodies_of_a_mouth_fill_it_without_touching(tmp_path: Path) -> None:
    teeth = (Tooth(11, ROOTED, CORE), Tooth(12, FREE))
    write_mesh(tmp_path / "teeth/11/outer.ply", ROOTED)
    write_mesh(tmp_path / "teeth/11/dentin.ply", CORE)
    write_mesh(tmp_path / "teeth/12/outer.ply", FREE)
    write_mouth_surfaces(tmp_path / "surfaces", teeth, gums(), wall())
    table = {f"{part}.sigma": 1.0 for part in ("11.enamel", "11.dentin", "12.enamel", "gums")}
    write_numbers(tmp_path, "thin", {"red": table | {name.replace("sigma", "alpha"): 0.5 for name in table}})
    found = {body.name: body for body in READER.Asset(tmp_path).bodies()}
    assert set(found) == {"tooth_11_enamel", "tooth_11_dentin", "tooth_12_enamel", "gums"}
    for body in found.values():
        assert closed(body).signed_volume_mm3() > 0
        assert (closed(body).edge_counts() == 2).all(), body.name
    # Every surface but a tooth's own stands in two bodies, of which one is moved.
    assert found["tooth_11_enamel"].moved
    assert not found["gums"].moved
    contrasts = {round(side.ior, 4) for side in found["tooth_11_enamel"].sides}
    assert contrasts == {IOR, round(IOR / GUMS_IOR, 4), 1.0}
    assert {side.ior for side in found["gums"].sides} == {GUMS_IOR, 1.0}


def test_contacts_belong_to_both_neighbours(tmp_path: Path) -> None:
    # Two ellipsoids that overlap a little, as neighbours of a scan do.
    left, right = ellipsoid(np.array([2.0, 2.0, 3.0])), ellipsoid(np.array([2.0, 2.0, 3.0]))
    right = Mesh(right.vertices_mm + np.array([3.9, 0.0, 0.0]), right.faces)
    for number, mesh in ((11, left), (12, right)):
        write_mesh(tmp_path / f"teeth/{number}/outer.ply", mesh)
    files = write_mouth_surfaces(tmp_path / "surfaces", (Tooth(11, left), Tooth(12, right)), None, None)
    assert "contact_11_12" in files
    table = {f"{part}.{name}": 0.5 for part in ("11.enamel", "12.enamel") for name in ("sigma", "alpha")}
    write_numbers(tmp_path, "matched", {"red": table})
    bodies = READER.Asset(tmp_path).bodies()
    for body in bodies:
        assert (closed(body).edge_counts() == 2).all(), body.name
    both = sum(closed(body).signed_volume_mm3() for body in bodies)
    assert both < left.signed_volume_mm3() + right.signed_volume_mm3()


@pytest.mark.parametrize(
    ("channels", "folder", "sentence"),
    [
        (["violet"], "whole", "The asset has no channel violet; it has red, green."),
        (
            [],
            "meshless",
            "has neither teeth/<number>/outer.ply nor object/outer.ply; put the script into an asset's folder.",
        ),
    ],
)
def test_bad_input_is_told(tmp_path: Path, channels: list[str], folder: str, sentence: str) -> None:
    write_tooth(tmp_path)
    if folder == "meshless":
        (tmp_path / "teeth/11/outer.ply").unlink()
    with pytest.raises(RuntimeError, match=sentence.replace(".", r"\.")):
        READER.Asset(tmp_path, channels).bodies()


def test_the_scripts_know_nothing_of_this_project(tmp_path: Path) -> None:
    for name in write_scripts(tmp_path):
        text = (tmp_path / name).read_text()
        assert "services" not in text
        assert "dentine" not in text
