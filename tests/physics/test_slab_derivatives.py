"""Slab derivatives compared to ``slab_derivatives.csv``, and the moving border compared to cases whose derivative is
exactly zero.

The rule requires a standard error of a third of 1 % (of the value, or of 1e-3 of the largest derivative of the same
case and source). Some values of the table need minutes for that. The border's ``c`` computed from its own two terms
needs days, because it is the small difference of two much larger terms. So the full rule is applied to the cases that
reach it, and to the border by the zero test; all 320 values are tested for bias at the error that seconds allow.
``tests/benchmarks/slab_table.py`` writes the error of every value.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.one_sided_border import leave_out_scattering
from tests.support.slab_tables import SlabCase, derivative_cases, fewer_lanes, named, passes, simulate, zero_cases
from tests.support.z_scores import LARGEST_Z, require_unbiased, z_scores

ZERO_TOLERANCE = 0.02
"""Tolerance of the zero derivative, as a fraction of the one-sided border term."""
AT_TOLERANCE = 70
"""Least number of the table's 320 values that reach the full rule's standard error in the short runs (74 were
counted)."""


def to_tolerance(case: SlabCase, seed: int, scale: float = 1.0) -> NDArray[np.float64]:
    """z-scores of a case that is traced until every standard error is a third of ``scale`` times its tolerance."""
    allowed = scale * case.derivative_tolerance() / 3
    sums = simulate(case, lambda sums: float((sums.standard_error()[1:] / allowed).max()), seed)
    assert (sums.standard_error()[1:] <= allowed).all(), case.name
    return z_scores(sums.mean()[1:], case.values[1:], sums.standard_error()[1:])


@pytest.mark.parametrize("scale", [2.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_derivatives_agree_within_some_percent(scale: float) -> None:
    cases = named(derivative_cases(), "S01", "S02", "S05")
    scores = [to_tolerance(case, 300 + number, scale) for number, case in enumerate(cases)]
    # The derivatives of one simulation share its paths, so each simulation counts as one independent value, which is
    # the worst case.
    require_unbiased(np.concatenate(scores), independent=len(cases))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["S03", "S06"])
def test_derivatives_of_denser_slabs_agree_within_one_percent(name: str) -> None:
    cases = named(derivative_cases(), name)
    require_unbiased(np.concatenate([to_tolerance(case, seed=400) for case in cases]), independent=len(cases))


@pytest.mark.slow
def test_all_derivatives_are_unbiased_at_the_error_reached() -> None:
    cases, scores, at_tolerance = derivative_cases(), [], 0
    for number, case in enumerate(cases):
        sums = simulate(case, passes(1), seed=500 + number, border_terms_only=True)
        scores.append(z_scores(sums.mean(), case.values, sums.standard_error()))
        at_tolerance += int(np.count_nonzero(sums.standard_error()[1:] <= case.derivative_tolerance() / 3))
    assert sum(map(len, scores)) == 320 + 64
    assert at_tolerance >= AT_TOLERANCE
    require_unbiased(np.concatenate(scores), independent=len(cases))


def test_extinction_scores_give_the_borders_derivative_too(monkeypatch: pytest.MonkeyPatch) -> None:
    # R and T depend on sigma_i d_i alone, so dR/dc = (sigma1/d1) dR/dsigma1 - (sigma2/d2) dR/dsigma2, which has a
    # fraction of the noise.
    fewer_lanes(monkeypatch)
    cases, scores = named(derivative_cases(), "S10", "S14", "S16"), []
    for number, case in enumerate(cases):
        sums = simulate(case, passes(1), seed=700 + number)
        scores.append(z_scores(sums.mean()[-1], case.values[-1], sums.standard_error()[-1]))
    require_unbiased(np.concatenate(scores), independent=len(cases))


def is_zero(value: float, error: float) -> bool:
    return abs(value) <= LARGEST_Z * error


@pytest.mark.parametrize(
    "case", ["Z1", "Z2", "Z3", "Z4", *(pytest.param(case, marks=pytest.mark.slow) for case in ("Z5", "Z6", "Z7"))]
)
def test_a_border_between_media_of_equal_albedo_and_phase_does_nothing(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if case < "Z5":  # the others need more walks
        fewer_lanes(monkeypatch)
    (slab,) = named(zero_cases(), case)
    seed = 600 + int(case[1])
    sums = simulate(slab, passes(2), seed, border_terms_only=True)
    leave_out_scattering(monkeypatch)
    one_sided = simulate(slab, passes(1), seed, border_terms_only=True)

    # The first row is the total reflectance, the last one dR/dc.
    value, error = sums.mean()[:, 0], sums.standard_error()[:, 0]
    assert abs(value[0] - slab.values[0, 0]) <= LARGEST_Z * error[0]
    assert error[-1] <= ZERO_TOLERANCE / 3 * abs(one_sided.mean()[-1, 0])
    assert is_zero(value[-1], error[-1])
    # Without the scattering term the same assertion fails, by a hundred standard errors.
    assert not is_zero(one_sided.mean()[-1, 0], one_sided.standard_error()[-1, 0])
    assert abs(one_sided.mean()[-1, 0]) > 50 * one_sided.standard_error()[-1, 0]
