"""The script builds the asset's scene in Blender, in each of the ways in which it is run."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.mitsuba.dielectric import ABSORPTION
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.stain_uv import ToothStains, stain_layout
from tests.support.clients import client_python, run_client
from tests.support.cycles_scenes import LAMP, Case, ball, cycles_image, write_case
from tests.support.small_tooth import camera_at

TISSUES = tuple(
    Tissue(Medium(sigma, 0.98, 0.8, 0.6, -0.2), Medium(2 * sigma, 0.9, 1.0, 0.5)) for sigma in (1.0, 1.25, 1.75)
)
VIEW = camera_at((0.3, 1.0, 0.2), size=16, span_mm=7.0)
CASE = Case(ball(3.0, 3), ball(2.4, 3), TISSUES, VIEW, "lamp")
FACTS = Path(__file__).parent / "blender_facts.py"
Facts = dict[str, Any]


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    client_python("bpy")
    folder = tmp_path_factory.mktemp("asset")
    write_case(folder, CASE)
    return folder


def facts_of(*words: str | Path) -> Facts:
    done = run_client("bpy", FACTS, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    found: Facts = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def save(folder: Path, *words: str) -> Facts:
    done = run_client("bpy", folder / "blender" / "blender_scene.py", "--save", folder / "tooth.blend", *words)
    assert done.returncode == 0, done.stderr
    return facts_of(folder / "tooth.blend")


@pytest.fixture(scope="module")
def saved(asset: Path) -> Facts:
    return save(asset)


def test_a_saved_file_holds_the_teeth_at_their_size(saved: Facts) -> None:
    assert list(saved["scenes"]) == ["teeth"]
    assert saved["others"] == []
    scene = saved["scenes"]["teeth"]
    assert set(scene["meshes"]) == {"tooth_11_enamel", "tooth_11_dentin"}
    enamel, dentin = scene["meshes"]["tooth_11_enamel"], scene["meshes"]["tooth_11_dentin"]
    np.testing.assert_allclose(enamel["dimensions"], np.ptp(CASE.outer.vertices_mm, axis=0), rtol=1e-3)
    # The gap of 1e-4 mm is 4e-5 of the dentin's size.
    np.testing.assert_allclose(dentin["dimensions"], np.ptp(ball(2.4, 3).vertices_mm, axis=0) - 2e-4, rtol=1e-6)
    shell = CASE.outer.signed_volume_mm3() - ball(2.4, 3).signed_volume_mm3()
    assert enamel["volume"] == pytest.approx(shell, rel=1e-5)
    assert enamel["uv_layers"] == ["UVMap"]
    assert {"ior", "outside"} <= set(enamel["attributes"])
    assert enamel["smooth"]
    assert scene["unit"] == ["METRIC", pytest.approx(1e-3)]


def test_a_saved_file_holds_the_coefficients(saved: Facts) -> None:
    meshes = saved["scenes"]["teeth"]["meshes"]
    sigma = np.array([tissue.enamel.sigma for tissue in TISSUES])
    first, second = meshes["tooth_11_enamel"]["material"]["volumes"]
    np.testing.assert_allclose(meshes["tooth_11_enamel"]["sigma_per_mm"], sigma, rtol=1e-12)
    np.testing.assert_allclose(first["absorption"], 0.02 * sigma, rtol=1e-6)
    np.testing.assert_allclose(first["scattering"], 0.8 * 0.98 * sigma, rtol=1e-6)
    np.testing.assert_allclose(second["scattering"], 0.2 * 0.98 * sigma, rtol=1e-6)
    assert second["absorption"] == [0.0, 0.0, 0.0]
    np.testing.assert_allclose([first["g"], second["g"]], [0.6, -0.2], rtol=1e-6)
    (core,) = meshes["tooth_11_dentin"]["material"]["volumes"]
    np.testing.assert_allclose(core["absorption"], 0.1 * 2 * sigma, rtol=1e-6)
    # Where indices match, nothing but the medium is there.
    kinds = meshes["tooth_11_enamel"]["material"]["kinds"]
    assert set(kinds) == {"ShaderNodeVolumeCoefficients", "ShaderNodeAddShader", "ShaderNodeOutputMaterial"}


def test_a_saved_file_holds_light_camera_and_settings(saved: Facts) -> None:
    scene = saved["scenes"]["teeth"]
    (lamp,) = scene["lamps"].values()
    assert lamp["energy"] == pytest.approx(4 * math.pi * 1e6, rel=1e-6)
    assert (lamp["color"], lamp["radius"], lamp["soft"], lamp["hidden"]) == ([1.0, 1.0, 1.0], 0.0, False, False)
    np.testing.assert_allclose(lamp["location"], LAMP.position_mm, rtol=1e-6)
    assert (scene["engine"], scene["filter"], scene["camera"]) == ("CYCLES", "BOX", "c0")
    assert set(scene["bounces"].values()) == {1024}
    assert scene["clamps"] == [0.0, 0.0, 0.0]
    assert scene["threshold"] == 0.0
    assert scene["changed_pixels"] == [False, False]
    assert scene["world"] == 0.0
    # A picture of 16 pixels is of no use to people.
    assert scene["size"] == [512, 512]
    (notes,) = saved["texts"].values()
    assert "red, green, blue" in notes


def test_the_text_editor_adds_a_scene_once_and_leaves_those_of_the_user(asset: Path) -> None:
    found = facts_of("--text", asset / "blender" / "blender_scene.py", "--", "--sky", "0.5", "--light", "none")
    assert list(found["scenes"]) == ["teeth"]
    scene = found["scenes"]["teeth"]
    assert set(scene["meshes"]) == {"tooth_11_enamel", "tooth_11_dentin"}
    assert scene["world"] == 0.5
    assert [lamp["hidden"] for lamp in scene["lamps"].values()] == [True]
    assert found["others"] == ["Scene"]


def test_millimetres_and_metres_give_the_same_picture(asset: Path) -> None:
    one, other = (cycles_image(asset, CASE, 16, 1, "--unit", unit) for unit in ("mm", "m"))
    assert one.max() > 0.05
    # Paths start alike and part where single precision rounds otherwise: at 1,024 paths a pixel the means of four
    # seeds differ by 7e-4. A power of the unit that is missing anywhere would be a factor of a thousand.
    assert abs(other.mean() / one.mean() - 1) < 0.03


def test_another_cosine_in_each_channel_is_rendered_channel_by_channel(tmp_path: Path) -> None:
    client_python("bpy")
    tissues = tuple(
        replace(TISSUES[0], enamel=replace(TISSUES[0].enamel, g1=g)) for g in (0.6, 0.3, 0.0)
    )  # fmt: skip
    case = replace(CASE, tissues=tissues)
    write_case(tmp_path, case)
    whole = cycles_image(tmp_path, case, 16, 3)
    for k, channel in enumerate(case.channels):
        alone = cycles_image(tmp_path, case, 16, 3, "--channels", channel)
        np.testing.assert_allclose(whole[..., k], alone[..., 0], rtol=1e-5, atol=1e-7)
    assert whole[..., 2].mean() > 1.02 * whole[..., 0].mean()
    found = save(tmp_path)
    assert len(found["scenes"]["teeth"]["meshes"]["tooth_11_enamel"]["material"]["volumes"]) == 4
    assert "channels one after another" in "".join(found["texts"].values())


def test_stains_darken_where_their_picture_says(tmp_path: Path) -> None:
    client_python("bpy")
    layout = stain_layout(CASE.outer, 1.0)
    depth = np.where(layout.points_mm[:, 2] > 0, 3.0, 0.0)
    write_case(tmp_path, CASE, ToothStains(layout.corners_uv, {"green": layout.texture(depth)}))
    image = cycles_image(tmp_path, CASE, 64, 1)
    upper, lower = image[2:6, 5:11].mean(axis=(0, 1)), image[10:14, 5:11].mean(axis=(0, 1))
    # Light passes the stain twice, at exp(-3) each time.
    assert upper[1] / upper[0] < 0.1 * lower[1] / lower[0]
    assert lower[1] > 0.5 * lower[0]
    assert save(tmp_path)["images"] == [["stain_green.png", True]]


def test_glass_and_subsurface_are_told(asset: Path, saved: Facts, tmp_path: Path) -> None:
    shutil.copytree(asset, tmp_path / "asset")
    rig = json.loads((tmp_path / "asset/rig.json").read_text())
    (tmp_path / "asset/rig.json").write_text(json.dumps(rig | {"boundary": "thin"}))
    glass = save(tmp_path / "asset", "--surface", "glass")
    assert "ShaderNodeBsdfGlass" in glass["scenes"]["teeth"]["meshes"]["tooth_11_enamel"]["material"]["kinds"]
    # The media of glass are those of the asset's scene_dielectric.xml, and the object keeps the numbers of the fit.
    enamel, usual = (each["scenes"]["teeth"]["meshes"]["tooth_11_enamel"] for each in (glass, saved))
    np.testing.assert_allclose(enamel["sigma_per_mm"], usual["sigma_per_mm"], rtol=1e-12)
    for converted, fitted in zip(enamel["material"]["volumes"], usual["material"]["volumes"], strict=True):
        np.testing.assert_allclose(converted["absorption"], ABSORPTION * np.array(fitted["absorption"]), rtol=1e-6)
        np.testing.assert_allclose(converted["scattering"], fitted["scattering"], rtol=1e-6)
    told = "".join(glass["texts"].values())
    assert "refracts" in told
    assert f"{ABSORPTION} times the absorption" in told
    simple = save(tmp_path / "asset", "--subsurface")
    assert list(simple["scenes"]["teeth"]["meshes"]) == ["tooth_11"]
    assert "Front light, distant shots" in "".join(simple["texts"].values())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--camera", "c9"], "The asset knows no c9; choose from c0."),
        (["--light", "sun"], "The asset knows no sun; choose from l0, none."),
        (["--environment", "absent.hdr"], "absent.hdr is no file; name a picture of an environment, HDR or EXR."),
    ],
)
def test_bad_requests_are_answered_by_a_sentence(asset: Path, words: list[str], sentence: str) -> None:
    done = run_client("bpy", asset / "blender" / "blender_scene.py", "--save", asset / "none.blend", *words)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1] == sentence
    assert not (asset / "none.blend").exists()


def test_a_script_without_an_asset_says_where_it_belongs(asset: Path, tmp_path: Path) -> None:
    shutil.copytree(asset / "blender", tmp_path / "blender")
    done = run_client("bpy", tmp_path / "blender" / "blender_scene.py", "--save", tmp_path / "none.blend")
    assert done.returncode == 1
    assert "No asset lies around this script" in done.stderr
