"""Truths that need no other renderer: a white tooth is invisible in a uniform room, and light paths are reversible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import single_tooth
from tests.support.small_tooth import CAMERA_DISTANCE_MM, camera_at, recipe, sphere, whole_view
from tests.support.z_scores import LARGEST_Z

FAR_MM = 1e4


def uniform_room(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) of lights that are spread evenly by a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)


@pytest.mark.parametrize(("samples", "tolerance"), [(6144, 0.02), pytest.param(24576, 0.01, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("boundary", "first_surface"), [("matched", 0.0), ("thin", ((1.631 - 1) / (1.631 + 1)) ** 2)])
def test_a_white_tooth_vanishes_in_a_uniform_room(
    boundary: Boundary, first_surface: float, samples: int, tolerance: float
) -> None:
    # Radiance 1 from all directions gives radiance 1 everywhere. The camera sees the centre of a ball so deep that no
    # unscattered light passes (optical depth 16). The first reflection of a thin boundary is left out, like highlights.
    lights = uniform_room(200)
    core = sphere(1.2)
    dentin = DentinShape.known(core)
    scene = single_tooth(
        sphere(2.0), dentin, FAR_MM * lights, np.full(len(lights), FAR_MM**2 * 4 * np.pi / len(lights)), boundary
    )
    tissue = Tissue(Medium(2, 1, 0.8, 0.5, -0.2), Medium(4, 1, 1, 0.3))
    view = whole_view(camera_at((0.3, 1, 0.2), size=4, span_mm=0.8))
    estimate = Engine(scene).images(tissue, view, samples=samples, seed=4)
    pixel = estimate.mean.sum(axis=0)
    error = pixel.std(ddof=1) / np.sqrt(len(pixel))
    # All pixels see the same radiance, so their spread is the noise.
    assert error <= tolerance / 3
    assert abs(pixel.mean() - (1 - first_surface)) <= LARGEST_Z * error


@pytest.mark.parametrize("boundary", ["matched", "thin"])
def test_camera_and_light_may_change_places(boundary: Boundary) -> None:
    # At a large distance, the radiance integrated over the tooth's outline per irradiance is the same when camera and
    # light are exchanged.
    directions = [(0.2, 1.0, 0.1), (0.9, -0.2, 0.6)]
    tissue = Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4, 0.7, 1, 0.5), (0.3, 0.9))
    values, variances = [], []
    for seed, (towards_camera, towards_light) in enumerate((directions, directions[::-1])):
        unit = np.array(towards_light) / np.linalg.norm(towards_light)
        scene = replace(
            recipe(boundary), light_positions_mm=50 * CAMERA_DISTANCE_MM * unit[None], light_intensities=np.array([1e8])
        )
        camera = camera_at(towards_camera, size=8, span_mm=9.0, distance_mm=50 * CAMERA_DISTANCE_MM)
        estimate = Engine(scene).images(tissue, whole_view(camera), samples=4096, seed=seed)
        values.append(estimate.mean.sum())
        variances.append(estimate.variance.sum())
    noise = np.sqrt(sum(variances))
    # From the two directions the outlines have different areas, so equality is no coincidence.
    assert noise <= 0.02 * values[0]
    assert abs(values[0] - values[1]) <= LARGEST_Z * noise
