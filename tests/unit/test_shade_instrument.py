"""Instruments for shades: geometries by their definition, placed on a tooth's surface."""

from __future__ import annotations

import numpy as np
import pytest

from services.assets.appearance.instrument import APERTURE_MM, DISTANCE_MM, GEOMETRIES, PIXELS, placed, spot_towards
from tests.support.small_tooth import SEMI_AXES_MM, ellipsoid

EYE_MM = np.array([0.0, 600.0, 0.0])


def test_a_ring_lies_at_45_degrees_and_a_sky_is_uniform() -> None:
    for directions in GEOMETRIES.values():
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
        np.testing.assert_allclose(directions[:, :2].mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(GEOMETRIES["45/0"][:, 2], np.cos(np.pi / 4))
    # Of light of equal radiance from all sides, half falls in within 45 degrees, and its cosine has a mean of 2/3.
    cosines = GEOMETRIES["d/0"][:, 2]
    assert cosines.mean() == pytest.approx(2 / 3, abs=0.01)
    assert (cosines > np.cos(np.pi / 4)).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("geometry", list(GEOMETRIES))
def test_every_light_brings_the_same_to_the_spot_and_the_camera_looks_along_the_normal(geometry: str) -> None:
    spot = spot_towards(ellipsoid(SEMI_AXES_MM), EYE_MM)
    # The ellipsoid's facets are some tenths of a millimetre.
    np.testing.assert_allclose(spot.point_mm, [0, SEMI_AXES_MM[1], 0], atol=0.05)
    np.testing.assert_allclose(spot.normal, [0, 1, 0], atol=0.02)
    at = placed(geometry, spot)
    towards = at.light_positions_mm - spot.point_mm
    distances = np.linalg.norm(towards, axis=1)
    irradiances = at.light_intensities * (towards @ spot.normal) / distances**3
    np.testing.assert_allclose(irradiances, irradiances[0])
    # A perfect diffuser sends out the irradiance divided by pi.
    assert at.white_radiance == pytest.approx(irradiances.sum() / np.pi)
    camera = at.view.camera
    pose = np.array(camera.camera_from_world)
    np.testing.assert_allclose(pose[:3, :3].T @ -pose[:3, 3], spot.point_mm + DISTANCE_MM * spot.normal, atol=1e-9)
    pixel, _ = camera.project(spot.point_mm[None])
    np.testing.assert_allclose(pixel, [[PIXELS / 2, PIXELS / 2]], atol=1e-9)
    edge = spot.point_mm + APERTURE_MM / 2 * pose[0, :3]
    np.testing.assert_allclose(camera.project(edge[None])[0], [[PIXELS, PIXELS / 2]], atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert len(at.view) == pytest.approx(np.pi / 4 * PIXELS**2, rel=0.1)
