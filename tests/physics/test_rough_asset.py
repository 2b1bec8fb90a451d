"""Stock Mitsuba's scene of a rough surface has mean factors for light that meets several facets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.assets.mitsuba.rough_surface import mean_albedos, rough_surface
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches
from services.core.files.meshes import write_mesh
from services.phantom.surface import INK
from services.transport.engine import Engine
from services.transport.platform import prepare_device
from tests.support.rough_truths import LIGHTS, TISSUE, scene_recipe, view
from tests.support.small_tooth import INTENSITY, sphere

ROUGHNESS, IOR = 0.3, 1.63


def test_factors_are_those_of_a_lossless_surface() -> None:
    outside, inside = mean_albedos(ROUGHNESS, IOR)
    # A facet loses 4.2 and 17.6 % of even light from outside and inside, by another program's walk.
    np.testing.assert_allclose((outside, inside), (0.958, 0.824), atol=0.002)
    surface = rough_surface(IOR, ROUGHNESS, compensated=True)
    # Light that comes in and goes out again has both sides' factors, and light that stays inside its own.
    assert surface["specular_transmittance"] ** 2 == pytest.approx(1 / (outside * inside))
    assert surface["specular_reflectance"] == pytest.approx(1 / inside)
    assert "specular_reflectance" not in rough_surface(IOR, ROUGHNESS, compensated=False)


@pytest.mark.dear("A rough surface is noisy in stock Mitsuba.")
def test_a_compensated_ball_is_as_bright_as_in_the_fit(tmp_path: Path) -> None:
    prepare_device()
    write_mesh(tmp_path / "outer.ply", sphere(2.0))
    images = []
    for tissue in (TISSUE, INK):
        scene = nested_scene(
            {"11": (tmp_path / "outer.ply", None)}, tissue, (view().camera,), LIGHTS[0].tolist(), INTENSITY,
            boundary="rough", ior=IOR, roughness=ROUGHNESS, compensated=True,
        )  # fmt: skip
        images.append(render_batches(load_scene(scene), 0, 16_384, 3))
    (whole, noise), (highlight, _) = images
    recipe = replace(scene_recipe(ROUGHNESS, IOR), multiple_scattering=True)
    fitted = Engine(recipe).images(TISSUE, view(), samples=16_384, seed=4)
    ratio = (whole - highlight).sum() / fitted.mean[0].sum()
    se = np.hypot(np.sqrt(noise.sum()), np.sqrt(fitted.variance[0].sum())) / fitted.mean[0].sum()
    # Mean factors leave 3 %; without any, this ball is 20 to 30 % too dark.
    assert se < 0.012
    assert abs(ratio - 1) < 0.03 + 4 * se
