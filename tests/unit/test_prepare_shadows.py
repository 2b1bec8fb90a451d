"""Shadows of objects that no scan shows, compared with spheres whose shadows follow from a formula."""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.shadow_map import is_unoccluded
from services.preprocess.masking.shadows import shadow_confidence
from services.preprocess.views.direct_light import expected_irradiance
from services.preprocess.views.projection import Footprint, project
from tests.support.shadowed_ball import BALL_MM, albedo, ball, before_ball, behind_ball, camera, lights_mm

PIXEL_MM = 0.25
CAMERA = camera(PIXEL_MM)


@pytest.fixture(scope="module")
def view() -> Footprint:
    return project(CAMERA, [ball(BALL_MM)])


def test_a_known_ball_shades_what_lies_behind_it(view: Footprint) -> None:
    points = view.points_mm(CAMERA, slice(None))
    radius = 2.0
    for light in lights_mm(6):
        place, centre = tuple(light.tolist()), before_ball(light, 9.0)
        reached = is_unoccluded(points, view.normal, place, [ball(BALL_MM), ball(radius, centre)])
        facing = view.covered & (expected_irradiance(points, view.normal, place, None) > 0.1e-6)
        # An edge may be off the formula's by one pixel of the light's view (0.25 mm); the smaller and the larger ball
        # allow for that and for the sagitta of the mesh
        surely, never = (behind_ball(points, light, centre, radius + margin) for margin in (-0.5, 0.5))
        assert (facing & surely).sum() > 50
        assert not reached[facing & surely].any()
        assert reached[facing & ~never].all()


@pytest.mark.parametrize("seed", [1, 2])
def test_shadows_of_an_unknown_ball_are_found_and_lit_pixels_are_left(view: Footprint, seed: int) -> None:
    """A matt ball of uneven albedo, without light that spreads inside: a capture requires that 90 % of the shadow is
    found, with 3 % of false finds.
    """
    rng = np.random.default_rng(seed)
    points = view.points_mm(CAMERA, slice(None)).astype(np.float64)
    places = lights_mm(12)
    shaded_by = {number: (before_ball(places[number], 9.0), 2.5) for number in (2, 5, 7)}
    irradiance = np.stack(
        [1e6 * expected_irradiance(points.astype(np.float32), view.normal, tuple(p.tolist()), None) for p in places]
    )
    shadow = np.zeros(irradiance.shape, dtype=bool)
    for number, (centre, radius) in shaded_by.items():
        shadow[number] = behind_ball(points, places[number], centre, radius)
    images = np.where(view.covered, albedo(points) * irradiance * ~shadow, 0)
    spread = 0.02 * images + 0.002
    photographs = (images + spread * rng.standard_normal(images.shape)).astype(np.float32)
    way = places[:, None, None] - points
    facing = (way * view.normal).sum(-1) / np.linalg.norm(way, axis=-1)
    confidence = shadow_confidence(
        photographs,
        (spread**2).astype(np.float32),
        irradiance.astype(np.float32),
        facing.astype(np.float32),
        view.covered,
        PIXEL_MM,
    )
    judged = view.covered & (facing > 0.1)
    found = confidence > 0.5
    assert shadow[judged].sum() > 100
    assert found[shadow & judged].mean() > 0.9
    assert found[~shadow & judged].mean() < 0.03
    assert confidence[:, ~view.covered].max() == 0


def test_nothing_is_said_of_pixels_without_light_or_value(view: Footprint) -> None:
    shape = (3, *view.covered.shape)
    irradiance = np.ones(shape, np.float32)
    irradiance[0] = 0
    variance = np.full(shape, 1e-4, np.float32)
    variance[1] = np.inf
    confidence = shadow_confidence(
        np.zeros(shape, np.float32), variance, irradiance, np.ones(shape, np.float32), view.covered, PIXEL_MM
    )
    assert not confidence[:2].any()


def test_a_value_without_certainty_is_as_likely_lit_as_shadowed(view: Footprint) -> None:
    shape = (6, *view.covered.shape)
    variance = np.full(shape, 1e-4, np.float32)
    variance[0] = 1e38
    faint, ones = np.full(shape, 1e-3, np.float32), np.ones(shape, np.float32)
    confidence = shadow_confidence(faint, variance, faint, ones, view.covered, PIXEL_MM)
    # Its own smallest error, 1e19 / 1e-3 / 1, has no square in float32
    assert np.all(confidence[0, view.covered] == 0.5)
    assert np.all(confidence[1:, view.covered] < 0.5)
