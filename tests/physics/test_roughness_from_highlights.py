"""The roughness of a surface by its highlights, from photographs by stock Mitsuba."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.fit.measurements.roughness.lobe import reflected
from services.fit.measurements.roughness.measure import roughness_from_highlights
from services.transport.platform import prepare_device
from tests.support.glossy_bodies import IOR, body, photographed, render, scanned


@cache
def images(roughness: float | None) -> NDArray[np.float64]:
    return render(roughness)


def test_lobe_equals_mitsubas_rough_dielectric() -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    random = np.random.default_rng(3)
    directions = random.normal(size=(2, 4000, 3))
    directions[..., 2] = np.abs(directions[..., 2]) + 0.02
    to_light, to_eye = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    surface = mi.load_dict(
        {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.2, "int_ior": IOR, "ext_ior": 1.0}
    )
    si = dr.zeros(mi.SurfaceInteraction3f, len(to_eye))
    si.wi = mi.Vector3f(to_eye.T.astype(np.float32))
    value = surface.eval(mi.BSDFContext(), si, mi.Vector3f(to_light.T.astype(np.float32)))
    dr.eval(value)
    # Single precision of the peer: 1e-7 times the peak's steepness, 1 / roughness^4
    normal = np.broadcast_to([0.0, 0.0, 1.0], to_light.shape)
    np.testing.assert_allclose(reflected(normal, to_light, to_eye, 0.2, IOR), np.array(value)[0], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("roughness", [0.1, 0.3])
def test_a_roughness_is_found_by_a_scan_that_is_off(roughness: float) -> None:
    glossy = images(roughness) + images(None)
    found = roughness_from_highlights(scanned(body(), 0.02, 1.0, seed=1), photographed(glossy, seed=2), IOR)
    # Within a tenth, and three of its standard errors, which must be no wider than that tenth
    assert abs(found.value / roughness - 1) < 0.1
    assert abs(found.value - roughness) < 3 * found.standard_error
    assert found.standard_error < 0.1 * roughness
    # The brightness, which the fit is free to choose, is that of the index
    assert abs(found.brightness - 1) < 3 * found.brightness_se
    assert abs(found.index - IOR) < 3 * found.index_se
    assert found.lights == 3
    assert found.warnings == ()


def test_a_matte_subject_is_refused() -> None:
    with pytest.raises(CaptureInputError, match=r"No photograph shows a highlight.*give roughness a number"):
        roughness_from_highlights(body(4), photographed(images(None), seed=2), IOR)


def test_a_highlight_may_be_saturated_in_its_core() -> None:
    glossy = images(0.1) + images(None)
    found = roughness_from_highlights(body(4), photographed(glossy, seed=3, full_scale=0.7 * glossy.max()), IOR)
    assert abs(found.value / 0.1 - 1) < min(0.1, 3 * found.standard_error / 0.1)


@pytest.mark.parametrize(("roughness", "full_scale"), [(0.1, 0.2), (0.1, 0.1), (0.3, 0.5), (0.3, 0.1)])
def test_saturated_highlights_are_refused(roughness: float, full_scale: float) -> None:
    glossy = images(roughness) + images(None)
    with pytest.raises(CaptureInputError, match=r"highlights are saturated.*give roughness a number"):
        roughness_from_highlights(body(4), photographed(glossy, seed=3, full_scale=full_scale * glossy.max()), IOR)


def test_wet_surfaces_are_told_by_the_brightness_and_keep_their_roughness() -> None:
    # A film of water reflects ((1.33 - 1) / (1.33 + 1))² at normal incidence, and bare enamel by 1.63
    film = ((IOR + 1) / (IOR - 1) * 0.33 / 2.33) ** 2
    found = roughness_from_highlights(body(4), photographed(film * images(0.1) + images(None), seed=3), IOR)
    assert abs(found.value / 0.1 - 1) < min(0.1, 3 * found.standard_error / 0.1)
    assert abs(found.index - 1.33) < 3 * found.index_se
    (warning,) = found.warnings
    assert "check ior (by the brightness alone 1.3" in warning


def test_photographs_without_a_mirror_direction_are_refused() -> None:
    photographs = photographed(images(0.1), seed=2)
    dark = [replace(one, usable=np.zeros_like(one.usable)) for one in photographs]
    with pytest.raises(CaptureInputError, match="No photograph shows lit surface around the mirror direction"):
        roughness_from_highlights(body(4), dark, IOR)
