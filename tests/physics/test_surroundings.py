"""Light of an environment around a fitted tooth has the right brightness and direction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.bench.figures.surroundings import environment_light, read_environment, render_under
from services.core.errors import InputError
from services.core.geometry import Mesh
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from tests.support.small_tooth import SEMI_AXES_MM, camera_at, ellipsoid

TISSUE = Tissue(Medium(3.0, 0.999999), Medium(9.0, 0.999999))
SAMPLES = 256


def surfaces() -> dict[str, Mesh]:
    return {"outer": ellipsoid(SEMI_AXES_MM), "dentin": ellipsoid(SEMI_AXES_MM - 0.3)}


def test_a_white_tooth_is_lit_from_the_roots_by_the_top_of_an_environment() -> None:
    prepare_device()
    sky = np.zeros((16, 32))
    sky[:8] = 2.0
    common: dict[str, Any] = {"samples": SAMPLES, "boundary": "matched", "ior": 1.631, "roughness": None}
    # The view is from the front with z upwards, so the roots are below.
    image = render_under(environment_light(sky, 0.0), surfaces(), TISSUE, camera_at((0, 1, 0)), **common)
    centre = slice(3, 5)
    roots, crown = image[5:7, centre].mean(), image[1:3, centre].mean()
    assert roots > crown + 0.3
    # What a white tooth sends out under half a sky of 2 and one turned over adds to 2: 4 standard errors of some 6 % of
    # a pixel, sixteen of them.
    turned = render_under(environment_light(sky[::-1].copy(), 0.0), surfaces(), TISSUE, camera_at((0, 1, 0)), **common)
    middle = (image + turned)[2:6, 2:6]
    assert middle.mean() == pytest.approx(2.0, abs=4 * middle.std() / 4)
    assert middle.std() < 0.4


def test_an_environment_has_a_mean_of_one_over_the_sphere(tmp_path: Path) -> None:
    prepare_device()
    import mitsuba as mi

    pixels = np.random.default_rng(1).uniform(0, 5, (8, 16, 3)).astype(np.float32)
    mi.Bitmap(pixels).write(str(tmp_path / "sky.exr"))
    read = read_environment(tmp_path / "sky.exr")
    assert read.shape == (8, 16, 3)
    weight = np.sin(np.pi * (np.arange(8) + 0.5) / 8)[:, None, None] * np.ones_like(read)
    assert (read * weight).sum() / weight.sum() == pytest.approx(1.0)
    # EXR files keep half precision.
    np.testing.assert_allclose(read / read[0, 0, 0], pixels / pixels[0, 0, 0], rtol=2e-3)
    with pytest.raises(InputError, match="does not exist"):
        read_environment(tmp_path / "none.hdr")
