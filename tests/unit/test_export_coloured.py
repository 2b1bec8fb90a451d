"""Scenes of an asset in linear sRGB and in spectra, rendered by stock Mitsuba, against its three scenes of one channel,
which the asset's own script renders and develops.
"""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.asset import write_asset
from services.assets.colour.develop import CapturedColours
from services.assets.content import RGB
from services.core.colour.cie import D65, delta_e_2000, lab_from_xyz
from services.core.geometry import Mesh, Tooth
from services.transport.optics.parameters import Medium, Tissue
from tests.support.colour_job import COLOURS, LIGHTS, report
from tests.support.prepared import camera, sphere

WHITE = LIGHTS[1].model_copy(update={"intensity": (1e6, 1e6, 1e6)})
DENSE = {
    channel: Tissue(Medium(3.0, albedo), Medium(4.0, albedo))
    for channel, albedo in zip(RGB, (0.97, 0.95, 0.90), strict=True)
}
"""Dense media that absorb, so that paths are short and the ball is nearly a half space."""
SAMPLES = 512
PER_RADIANCE = np.pi * float(np.square(WHITE.position_mm).sum()) / 1e6
"""One over the radiance of a white diffuser that faces the light."""
XYZ_FROM_SRGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


RENDER = """
import json, sys
import mitsuba as mi
import numpy as np
scene, variant, width, height, samples = sys.argv[1:]
mi.set_variant(variant)
loaded = mi.load_file(scene, optimize=False, width_0=int(width), height_0=int(height))
image = np.array(mi.render(loaded, spp=int(samples), seed=3), dtype=np.float64)[..., :3]
print(json.dumps(image.mean(axis=(0, 1)).tolist()))
"""


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of enamel and dentin with the dense media."""
    folder, ball = tmp_path_factory.mktemp("asset"), sphere(4.0)
    tooth = Tooth(11, ball, Mesh(0.8 * ball.vertices_mm, ball.faces))
    write_asset(
        folder, report(media=DENSE), (tooth,), (camera("c0"),), (WHITE,), channels=RGB, boundary="matched",
        ior=1.631, colours=CapturedColours(RGB, COLOURS),
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def channels(asset: Path) -> tuple[np.ndarray, np.ndarray]:
    """The ball's mean colour by the three scenes of one channel: in the camera's channels, and developed to linear
    sRGB by its matrix.
    """
    script = runpy.run_path(str(asset / "render.py"))
    image = script["render"](asset, "c0", "l1", SAMPLES)
    found = script["develop"](image, asset, "c0", "l1", "srgb").mean(axis=(0, 1))
    return image.mean(axis=(0, 1)) * PER_RADIANCE, found


def shown(asset: Path, scene: str, variant: str) -> np.ndarray:
    """The ball's mean linear sRGB by a scene in colour, 1 for a white diffuser that faces the light."""
    # A process keeps one variant, so another one renders.
    width, height = camera("c0").size
    given = str(asset / scene), variant, str(width), str(height), str(SAMPLES)
    done = subprocess.run([sys.executable, "-c", RENDER, *given], capture_output=True, text=True, check=True)
    return np.array(json.loads(done.stdout.splitlines()[-1])) * PER_RADIANCE


def difference(one: np.ndarray, other: np.ndarray, white: float) -> float:
    """ΔE2000 of two linear sRGB colours, of which ``white`` is shown as white."""
    lab = [lab_from_xyz((each / white)[None] @ XYZ_FROM_SRGB.T, D65) for each in (one, other)]
    return float(delta_e_2000(*lab)[0])


@pytest.mark.parametrize(("scene", "variant"), [("scene_srgb.xml", "llvm_ad_rgb"),
                                                ("scene_spectral.xml", "llvm_ad_spectral")])  # fmt: skip
def test_a_scene_in_colour_looks_as_its_channels_do(
    asset: Path, channels: tuple[np.ndarray, np.ndarray], scene: str, variant: str
) -> None:
    camera_colour, developed = channels
    white = 1.3 * float(developed.max())
    error = difference(shown(asset, scene, variant), developed, white)
    # A difference of 0.8 is just seen by half of all observers (ISO/TR 28642); the means have 1 % of noise, or 0.4.
    assert error < 0.8
    assert 2 * error < difference(camera_colour, developed, white)


def test_colour_json_has_every_medium_in_three_forms(asset: Path) -> None:
    told = json.loads((asset / "colour.json").read_text())
    assert {"linear sRGB", "ACEScg", "spectral", "told", "units"} == told.keys()
    assert told["told"]["spectral"].startswith("upsampled")
    for space, count in (("linear sRGB", 3), ("ACEScg", 3), ("spectral", 31)):
        for part in ("enamel", "dentin"):
            table: dict[str, Any] = told[space][part]
            assert [len(table[name]) for name in ("sigma_s_reduced", "sigma_a", "reflectance")] == [count] * 3
    assert len(told["spectral"]["wavelength_nm"]) == 31
    # The matrix of this camera takes green from red, so that red absorbs less than in the camera.
    medium = DENSE["red"].dentin
    assert told["linear sRGB"]["dentin"]["sigma_a"][0] < (1 - medium.alpha) * medium.sigma


def test_an_asset_of_one_channel_has_no_colours(tmp_path: Path) -> None:
    ball = sphere(4.0)
    green = WHITE.model_copy(update={"intensity": (1e6,)})
    write_asset(
        tmp_path, report(("green",)), (Tooth(11, ball, None),), (camera("c0"),), (green,), channels=("green",),
        boundary="matched", ior=1.631,
    )  # fmt: skip
    assert not [path for path in tmp_path.iterdir() if "colour" in path.name or "srgb" in path.name]
    assert "colour" not in json.loads((tmp_path / "rig.json").read_text())
