"""A connection chooses one light of every group, each in proportion to its brightness, for any number of lights."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.phantom.dome_rig import dome_lights
from services.transport.platform import prepare_device

POINT_MM = (1.0, -2.0, 3.0)
AHEAD = np.array([0.6, 0.0, 0.8])
DRAWS = 4096


def lobe(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Test importance by the cosine; the ratio of its largest to its smallest value is 3 million."""
    return (1.005 - cosine) ** -2.5


@pytest.mark.parametrize("lights", [1, 2, 7, 54, 155])
def test_a_light_is_chosen_as_often_as_it_is_bright(lights: int) -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.lighting.light_groups import LightGroups

    rig = dome_lights(lights, ("green",), seed=1)
    positions, intensities = (
        np.array([light.position_mm for light in rig]),
        np.random.default_rng(2).uniform(0.1, 1, lights),
    )
    groups = LightGroups(positions, intensities)
    draw = dr.arange(mi.UInt32, groups.count * DRAWS)
    group, u = draw // DRAWS, (mi.Float(draw % DRAWS) + 0.5) / DRAWS

    def importance(direction: mi.Vector3f) -> mi.Float:
        return dr.power(1.005 - dr.dot(direction, mi.Vector3f(AHEAD.tolist())), -2.5)

    light, total = groups.choose(group, dr.repeat(mi.Point3f(POINT_MM), groups.count * DRAWS), importance, u)
    found, totals = np.array(light), np.array(total).reshape(groups.count, DRAWS)[:, 0].astype(np.float64)

    towards = positions - POINT_MM
    squared = np.sum(towards**2, axis=1)
    brightness = lobe(towards @ AHEAD / np.sqrt(squared)) * intensities / squared
    # The number of equally spaced draws in an interval of (0, 1) is its width times their count, to within one; the
    # rest of the tolerance is single precision.
    counts = np.array([np.bincount(row, minlength=lights) for row in found.reshape(groups.count, DRAWS)])
    of = counts.argmax(axis=0)
    of[counts.sum(axis=0) == 0] = -1
    assert ((counts > 0).sum(axis=0) <= 1).all()
    for k in range(groups.count):
        shares = counts[k] / DRAWS * totals[k]
        assert np.abs(shares - np.where(of == k, brightness, 0))[of >= 0].max() <= totals[k] * (1 / DRAWS + 1e-4)
    assert totals.sum() == pytest.approx(brightness.sum(), rel=1e-4)


def test_no_light_of_no_brightness_is_chosen() -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.lighting.light_groups import LightGroups

    # Seven lights fill three groups and leave two places empty; lights at negative x have zero importance.
    positions = np.array([light.position_mm for light in dome_lights(7, ("green",), seed=1)])
    groups = LightGroups(positions, np.ones(7))
    draw = dr.arange(mi.UInt32, groups.count * DRAWS)
    u = mi.Float(draw % DRAWS) / DRAWS
    u = dr.select(draw % DRAWS == DRAWS - 1, 0.99999994, u)
    point = dr.repeat(mi.Point3f(0, 0, 0), groups.count * DRAWS)
    light, total = groups.choose(draw // DRAWS, point, lambda direction: dr.select(direction.x > 0, mi.Float(1), 0), u)
    ahead, chosen = np.flatnonzero(positions[:, 0] > 0), np.array(light)[np.array(total) > 0]
    assert 0 < len(ahead) < 7
    assert set(chosen.tolist()) == set(ahead.tolist())
