"""The asset's own script renders it in stock Mitsuba with the same images as the engine's."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.assets.asset import tissue_of, write_asset
from services.assets.mitsuba.scene import load_scene, nested_scene, sensor_dict, with_square_pixels
from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light, Tooth
from services.core.records import Boundary
from services.core.results import Estimate, FitReport
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.stain_paint import painted_depth
from services.transport.engine import Engine
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import View, single_tooth
from services.transport.scene.stain_uv import ToothStains, stain_layout

TISSUE = Tissue(Medium(2.5, 0.97, 0.9, 0.6, -0.1), Medium(6.0, 0.93, 1.0, 0.5, 0.0))
"""Tissue with paths of some tens of scattering events, so that the comparison takes seconds."""
CHANNELS = ("red", "green")


def report_of(tissue: Tissue) -> FitReport:
    table = {
        f"{part}.{field}": Estimate(value=getattr(getattr(tissue, part), field), se=0.01, unit="1", determined=True)
        for part in ("enamel", "dentin")
        for field in MEDIUM_FIELDS
    }
    errors = dict.fromkeys(CHANNELS, 0.03)
    parameters = dict.fromkeys(CHANNELS, table)
    return FitReport(
        converged=True, advice="", parameters=parameters, fit_error=errors, held_out_error=errors, steps=3, seconds=1.0
    )


class Rig:
    def __init__(self) -> None:
        incisor = build_incisor(24)
        self.tooth = Tooth(11, incisor.outer, incisor.dentin)
        self.cameras: tuple[Camera, ...] = dome_cameras(2, 1.2, (incisor.outer,))
        self.lights: tuple[Light, ...] = dome_lights(4, CHANNELS, seed=2)

    def write(self, folder: Path, boundary: Boundary, stains: ToothStains | None = None) -> tuple[str, ...]:
        return write_asset(
            folder, report_of(TISSUE), (self.tooth,), self.cameras, self.lights, channels=CHANNELS, boundary=boundary,
            ior=1.631, stains=stains
        )  # fmt: skip

    def engine_image(
        self,
        boundary: Boundary,
        camera: Camera,
        light: Light,
        channel: int,
        samples: int,
        stains: ToothStains | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        dentin = self.tooth.dentin
        assert dentin is not None
        shape = DentinShape.known(dentin)
        recipe = single_tooth(
            self.tooth.outer,
            shape,
            np.array([light.position_mm]),
            np.array([light.intensity[channel]]),
            boundary,
            1.631,
        )
        tissue = TISSUE
        if stains is not None:
            recipe = replace(recipe, teeth=(replace(recipe.teeth[0], stain_uv=stains.corners_uv),))
            tissue = replace(TISSUE, stain=stains.textures.get(CHANNELS[channel]))
        width, height = camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(np.int32)
        estimate = Engine(recipe).images(tissue, View(camera, pixels), samples=samples, seed=11)
        return estimate.mean[0].reshape(height, width), estimate.variance[0].reshape(height, width)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig()


@pytest.fixture(scope="module")
def stains(rig: Rig) -> ToothStains:
    # The stains are strong, and in one channel only.
    layout = stain_layout(rig.tooth.outer, 1.0)
    return ToothStains(layout.corners_uv, {"green": layout.texture(painted_depth(layout, 3, strength=2.0))})


@pytest.mark.parametrize(
    ("boundary", "stained"),
    [
        ("matched", False),
        ("thin", True),
        pytest.param("thin", False, marks=pytest.mark.slow),
        pytest.param("matched", True, marks=pytest.mark.slow),
    ],
)
def test_stock_mitsuba_shows_what_the_engine_shows(
    rig: Rig, stains: ToothStains, boundary: Boundary, stained: bool, tmp_path: Path
) -> None:
    prepare_device()
    shown = stains if stained else None
    rig.write(tmp_path, boundary, shown)
    render = runpy.run_path(str(tmp_path / "render.py"))["render"]
    light, camera = rig.lights[2], rig.cameras[1]
    stack = np.stack([render(tmp_path, camera.name, light.name, 16, seed=seed) for seed in range(16)])
    assert stack.shape[1:] == (camera.size[1], camera.size[0], 2)
    mean, variance = stack.mean(axis=0), stack.var(axis=0, ddof=1) / len(stack)
    scores = []
    for channel in range(2):
        ours, ours_variance = rig.engine_image(boundary, camera, light, channel, 512, shown)
        assert ours.sum() > 1
        for rows in np.array_split(np.arange(camera.size[1]), 4):
            noise = variance[rows, :, channel].sum() + ours_variance[rows].sum()
            scores.append((mean[rows, :, channel] - ours[rows]).sum() / np.sqrt(noise))
            # One standard error is at most 4 % of a band with light, so that errors of a band would show.
            if ours[rows].sum() > 0.1 * ours.sum():
                assert np.sqrt(noise) < 0.04 * ours[rows].sum()
    # Eight values: |z| <= 4.5 fails one correct run in 10,000.
    assert np.abs(scores).max() <= 4.5


def test_the_folder_is_complete_and_self_contained(rig: Rig, tmp_path: Path) -> None:
    files = rig.write(tmp_path / "thin", "thin")
    assert set(files) == {
        "scene_red.xml", "scene_green.xml", "teeth/11/outer.ply", "teeth/11/dentin.ply", "rig.json",
        "parameters.json", "errors.json", "render.py", "thin_boundary.py", "scene_dielectric.xml",
    }  # fmt: skip
    assert "thin_boundary.py" not in rig.write(tmp_path / "matched", "matched")
    for name in ("render.py", "thin_boundary.py"):
        assert "services" not in (tmp_path / "thin" / name).read_text()
    assert str(tmp_path) not in (tmp_path / "thin/scene_red.xml").read_text()
    parameters = json.loads((tmp_path / "thin/parameters.json").read_text())
    assert parameters["red"]["enamel.sigma"] == {"value": 2.5, "se": 0.01, "unit": "1", "determined": True}
    assert json.loads((tmp_path / "thin/errors.json").read_text())["held_out_error"] == {"red": 0.03, "green": 0.03}


def test_textures_come_with_their_place_and_as_fitted(rig: Rig, stains: ToothStains, tmp_path: Path) -> None:
    from PIL import Image

    assert {"teeth/11/stain_green.npy", "teeth/11/stain_green.png"} <= set(rig.write(tmp_path, "matched", stains))
    a_t = stains.textures["green"].transmittance
    np.testing.assert_allclose(np.load(tmp_path / "teeth/11/stain_green.npy"), a_t, rtol=1e-6)
    # The picture stores 16 bits, rounded.
    np.testing.assert_allclose(
        1 - np.asarray(Image.open(tmp_path / "teeth/11/stain_green.png")) / 65535, a_t, atol=0.51 / 65535
    )
    assert "stain" not in (tmp_path / "scene_red.xml").read_text()


def test_the_script_runs_alone(rig: Rig, tmp_path: Path) -> None:
    rig.write(tmp_path, "thin")
    command = [
        sys.executable,
        "-I",
        str(tmp_path / "render.py"),
        "--camera",
        "c0",
        "--light",
        "l1",
        "--spp",
        "4",
        "--out",
        str(tmp_path / "tooth.exr"),
    ]
    # Isolated mode leaves the script's folder out of the module path, as a user's own set-up might.
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "tooth.exr").stat().st_size > 500


def test_a_table_becomes_the_tissue_it_describes() -> None:
    table = report_of(TISSUE).parameters["red"]
    assert tissue_of(table) == TISSUE
    homogeneous = tissue_of({name: estimate for name, estimate in table.items() if name.startswith("enamel")})
    assert homogeneous.enamel == TISSUE.enamel
    assert homogeneous.dentin.sigma == 0


def test_pixels_land_where_the_camera_projects_them(rig: Rig) -> None:
    # Compare a camera with a shifted principal point and a rolled pose to Mitsuba's own rays.
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    camera = rig.cameras[0].model_copy(update={"K": ((900.0, 0.0, 3.7), (0.0, 900.0, 9.1), (0.0, 0.0, 1.0))})
    sensor = load_scene({"type": "scene", "camera": sensor_dict(camera)}).sensors()[0]
    places = np.array([[0.5, 0.5], [4.2, 1.1], [2.0, 7.9]])
    scaled = places / np.array(camera.size)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(scaled.T.astype(np.float32)), mi.Point2f(0.5))
    dr.eval(ray)
    _, directions = camera.rays(places[:, 0], places[:, 1])
    # The tolerance is single precision of a pixel's angle, 1e-3 rad at 1e-7 relative, with a margin for the matrix
    # product.
    np.testing.assert_allclose(np.array(ray.d).T, directions, atol=2e-6)


def test_rectangular_pixels_are_refused(rig: Rig) -> None:
    camera = rig.cameras[0].model_copy(update={"K": ((900.0, 0.0, 5.0), (0.0, 910.0, 5.0), (0.0, 0.0, 1.0))})
    with pytest.raises(CaptureInputError, match="unequal focal lengths"):
        sensor_dict(camera)


def test_a_calibrated_cameras_pixels_are_drawn_square_where_they_nearly_are(rig: Rig) -> None:
    camera = rig.cameras[0].model_copy(update={"K": ((3850.0, 0.0, 200.0), (0.0, 3853.0, 150.0), (0.0, 0.0, 1.0))})
    drawn = with_square_pixels(camera)
    sensor_dict(drawn)
    # An error of 0.04 % in the focal length moves a point a hundred pixels from the principal point by 0.04 px.
    points = np.random.default_rng(0).uniform(-10, 10, (100, 3))
    near = np.abs(camera.project(points)[0] - [200.0, 150.0]).max(axis=1) < 100
    assert np.abs(drawn.project(points)[0] - camera.project(points)[0])[near].max(initial=0.0) < 0.05
    uneven = camera.model_copy(update={"K": ((3850.0, 0.0, 200.0), (0.0, 3950.0, 150.0), (0.0, 0.0, 1.0))})
    assert with_square_pixels(uneven) == uneven


def test_a_tooth_without_dentin_needs_one_medium(rig: Rig, tmp_path: Path) -> None:
    scene = nested_scene({"11": (tmp_path / "outer.ply", None)}, TISSUE, rig.cameras, (0, 0, 1), 1.0)
    assert "medium_dentin" not in scene
    assert "exterior" not in scene["outer_11"]
