"""Boundary models as objects, against stock Mitsuba's Fresnel equations and surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.errors import SettingsError
from services.transport.boundary.models import MESH_MODELS, SLAB_MODELS, mesh_boundary, slab_boundary
from services.transport.platform import prepare_device

IOR = 1.631
COSINES = np.linspace(0.05, 1, 20, dtype=np.float32)


@pytest.mark.parametrize("name", sorted(SLAB_MODELS))
def test_light_through_a_flat_face_is_that_of_stock_mitsuba(name: str) -> None:
    prepare_device()
    import mitsuba as mi

    boundary, outside = slab_boundary(name, IOR), mi.Float(COSINES)
    mirrored, bent, _, _ = mi.fresnel(outside, mi.Float(IOR))
    expected = np.zeros(20) if name == "matched" else np.array(mirrored)
    cosine = -np.array(bent) if name == "smooth" else COSINES
    entered, inside = boundary.enter(outside)
    exit_inside, narrowing, reflected = boundary.leave(outside)
    # Single precision: a few roundings of numbers of order one.
    np.testing.assert_allclose(np.array(entered + mi.Float(0 * COSINES)), 1 - expected, atol=1e-6)
    np.testing.assert_allclose(np.array(reflected + mi.Float(0 * COSINES)), expected, atol=1e-6)
    for found in (inside, exit_inside):
        np.testing.assert_allclose(np.array(found), cosine, atol=1e-6)
    back = boundary.reflectance_inside(inside) + mi.Float(0 * COSINES)
    # The same light is reflected from both sides of a pair of directions. At 0.05 outside, the reflectance changes by
    # 170 per unit of the inner cosine, which is rounded to 6e-8.
    np.testing.assert_allclose(np.array(back), expected, atol=1.5e-5)
    assert np.allclose(np.array(narrowing), IOR**2 if name == "smooth" else 1)


def test_a_surface_without_contrast_is_matched_by_every_model() -> None:
    prepare_device()
    assert all(mesh_boundary(name, 1.0, refracts=False).unaltered for name in MESH_MODELS)
    assert all(slab_boundary(name, 1.0).unaltered for name in SLAB_MODELS)
    assert not any(mesh_boundary(name, IOR).unaltered for name in MESH_MODELS if name != "matched")


def test_an_unknown_model_is_refused_with_the_known_names() -> None:
    with pytest.raises(SettingsError, match=r"'smooth' is not known; known are matched, rough, thin"):
        mesh_boundary("smooth", IOR)
