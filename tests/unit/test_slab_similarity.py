"""Long steps of a slab's fit in a thick cell keep sigma_s', which is all that its images fix."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.slab.cell.dictionary import KNOTS, henyey_greenstein
from services.slab.solve.coordinates import MAX_LN_SCATTERING_CHANGE, Knots, reduced_scattering_slope

MATERIAL = henyey_greenstein(5.0, 0.2, 0.1)
KNOWN = Knots()


def forward_step(size: float) -> np.ndarray:
    """More scattering, all of it forward, at a constant sigma_s' to first order."""
    change = np.append(np.cos(np.linspace(0, math.pi, KNOTS)), 0.0)
    slope = reduced_scattering_slope(MATERIAL)
    change[:KNOTS] -= float(slope @ change) / float(slope[:KNOTS].sum())
    return np.asarray(size * change)


def test_the_slope_of_reduced_scattering_is_that_of_a_small_step() -> None:
    rng = np.random.default_rng(1)
    small = 1e-6 * rng.standard_normal(KNOTS + 1)
    moved = KNOWN.material_at(KNOWN.unknowns(MATERIAL) + small)
    found = math.log(moved.reduced_scattering_per_mm / MATERIAL.reduced_scattering_per_mm)
    # The difference is of second order, 1e-12, besides rounding of 1e-16 in numbers of about one.
    assert found == pytest.approx(float(reduced_scattering_slope(MATERIAL) @ small), abs=1e-11)


def test_a_long_step_at_a_constant_reduced_scattering_keeps_it() -> None:
    change = forward_step(0.5)
    x = KNOWN.unknowns(MATERIAL)
    plain, similar = (KNOWN.material_at(x + one) for one in (change, KNOWN.similarity_step(change, MATERIAL)))
    true = MATERIAL.reduced_scattering_per_mm
    assert abs(plain.reduced_scattering_per_mm / true - 1) > 0.02
    assert similar.reduced_scattering_per_mm == pytest.approx(true, rel=1e-9)
    assert similar.mean_cosine > MATERIAL.mean_cosine + 0.05


def test_no_step_is_longer_than_is_good_for() -> None:
    step = KNOWN.similarity_step(forward_step(20.0), MATERIAL)
    slope = MATERIAL.slope_of_scattering() / MATERIAL.scattering_per_mm
    # The length is limited to first order, before the step is scaled to its sigma_s'.
    direction = forward_step(1.0)
    size = MAX_LN_SCATTERING_CHANGE / float(slope @ direction)
    bent = step - size * direction
    np.testing.assert_allclose(bent[:KNOTS], bent[0], atol=1e-12)
