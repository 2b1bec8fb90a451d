"""The virtual dome: its cameras and lights see and light the tooth as a capture requires."""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.templates.incisor import build_incisor
from services.phantom.dome_rig import RADIUS_MM, dome_cameras, dome_lights


@pytest.mark.parametrize("count", [5, 8, 54])
def test_lights_cover_the_front_grazing_and_the_edge(count: int) -> None:
    positions = np.array([light.position_mm for light in dome_lights(count, ("green",), seed=0)])
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), RADIUS_MM)
    from_front_deg = np.degrees(np.arccos(positions[:, 1] / RADIUS_MM))
    assert from_front_deg.min() < 32
    assert ((from_front_deg > 70) & (from_front_deg < 95)).any()
    assert from_front_deg.max() > 97


def test_lights_differ_as_leds_do_and_repeat_by_seed() -> None:
    first, again, other = (dome_lights(8, ("red", "green", "blue"), seed=seed) for seed in (0, 0, 1))
    assert first == again
    assert first != other
    red, green, blue = np.array([light.intensity for light in first]).T
    assert np.ptp(red) > 0.05 * red.mean()
    np.testing.assert_allclose(blue / green, 0.9)


@pytest.mark.parametrize(("count", "pixel_mm"), [(1, 0.5), (3, 0.25)])
def test_cameras_frame_the_tooth_at_the_pixel_size_asked_for(count: int, pixel_mm: float) -> None:
    outer = build_incisor(24).outer
    cameras = dome_cameras(count, pixel_mm, (outer,))
    assert len({camera.name for camera in cameras}) == count
    for camera in cameras:
        pixels, depth = camera.project(outer.vertices_mm)
        assert (depth > 0).all()
        margin = np.stack([pixels.min(axis=0), np.array(camera.size) - pixels.max(axis=0)])
        assert (margin >= 2).all()
        assert (margin <= 3.01).all()
        # 13.5 mm of tooth, seen up to 10 degrees away from square to its axis and 1 % nearer or farther.
        assert np.ptp(pixels[:, 1]) * pixel_mm == pytest.approx(13.5, abs=0.9)
        # The incisal edge hangs down in the picture.
        assert pixels[outer.vertices_mm[:, 2].argmax(), 1] > pixels[outer.vertices_mm[:, 2].argmin(), 1]
