"""A slab offers the walk all that any geometry offers, also for features that layers lack."""

from __future__ import annotations

import numpy as np

from services.transport.platform import prepare_device


def test_layers_mix_with_nothing() -> None:
    prepare_device()
    import mitsuba as mi

    from services.transport.scene.geometry import SlabGeometry

    slab = SlabGeometry((1.0, 2.0), moving_border=True)
    place, where, active = mi.UInt32([1, 2, 3]), mi.Point3f([0, 0, 0], [0, 0, 0], [0.5, 1.5, 4]), mi.Bool(True)
    mixed = slab.mixed(where, place, active)
    np.testing.assert_array_equal(np.array(mixed.share_of(1)), [1, 0, 0])
    np.testing.assert_array_equal(np.array(mixed.share_of(2)), [0, 1, 0])
    assert np.array(mixed.slope).max() == 0
    (motion,) = slab.mixture_motion(where, 0, active)
    assert np.array(motion).max() == 0
