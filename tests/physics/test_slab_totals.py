"""Slab totals compared to ``slab_totals.csv``, and conservation of energy."""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.simulate import Layer, Sums
from tests.support.slab_tables import SOURCES, SlabCase, fewer_lanes, is_costly, simulate, total_cases
from tests.support.z_scores import require_unbiased, z_scores

TOLERANCE, THIN_TOLERANCE, FINE_TOLERANCE = 2e-3, 3e-4, 1e-4
"""Tolerances of all slabs, of thin ones, whose paths are short, and of all in a slow run."""


@pytest.fixture(autouse=True)
def _short_first_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer_lanes(monkeypatch)


def simulate_totals(case: SlabCase, tolerance: float, seed: int) -> Sums:
    """Simulate totals until their standard error is a third of the tolerance."""
    return simulate(case, lambda sums: float(sums.standard_error().max() / (tolerance / 3)), seed)


def require_totals(cases: list[SlabCase], tolerance: float, seed: int) -> None:
    scores = []
    for number, case in enumerate(cases):
        sums = simulate_totals(case, tolerance, seed + number)
        assert sums.standard_error().max() <= tolerance / 3, case.name
        scores.append(z_scores(sums.mean(), case.values, sums.standard_error()))
    # R and T of one simulation share their paths, so each simulation counts as one independent value, which is the
    # worst case.
    require_unbiased(np.concatenate(scores), independent=len(cases))


def test_totals_agree_with_adding_doubling() -> None:
    cases = [case for case in total_cases() if not is_costly(case)]
    assert len(cases) == 28
    require_totals(cases, TOLERANCE, seed=101)


def test_totals_of_thin_slabs_agree_more_closely() -> None:
    cases = [case for case in total_cases() if case.layers[0].thickness_mm <= 1 and case.source == "normal"]
    assert len(cases) == 5
    require_totals(cases, THIN_TOLERANCE, seed=131)


@pytest.mark.slow
def test_totals_agree_to_four_digits() -> None:
    require_totals([case for case in total_cases() if not is_costly(case)], FINE_TOLERANCE, seed=151)


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES)
def test_totals_of_the_deepest_white_slabs_agree(source: str) -> None:
    cases = [case for case in total_cases() if is_costly(case) and case.source == source]
    assert len(cases) == 3
    require_totals(cases, 1e-3, seed=201)


@pytest.mark.parametrize(("boundary", "ior"), [("matched", 1.0), ("thin", 1.631), ("smooth", 1.5)])
@pytest.mark.parametrize("source", SOURCES)
def test_white_slabs_return_all_light(boundary: str, ior: float, source: str) -> None:
    # |R + T - 1| < 1e-3. R and T of a white slab are nearly perfectly anticorrelated, so the error of their sum is far
    # below this even with larger errors of each.
    layers = (
        Layer(sigma=3, alpha=1, g1=0.6, thickness_mm=0.5),
        Layer(sigma=6, alpha=1, beta=0.8, g1=0.7, g2=-0.2, thickness_mm=0.5),
    )
    case = SlabCase("white", layers, boundary, ior, source, (), np.zeros((1, 2)))
    mean = simulate_totals(case, 3e-3, seed=7).mean()[0]
    assert abs(mean.sum() - 1) < 1e-3
    assert 0.1 < mean[0] < 0.9


@pytest.mark.parametrize("boundary", ["matched", "thin", "smooth"])
def test_energy_never_grows(boundary: str) -> None:
    # More absorption lowers the sum of R and T.
    last = 1.001
    for alpha in (1 - 1e-7, 0.999, 0.9, 0.0):
        layers = (Layer(sigma=4, alpha=alpha, g1=0.7, thickness_mm=1),)
        total = (
            simulate_totals(SlabCase("grey", layers, boundary, 1.5, "diffuse", (), np.zeros((1, 2))), 3e-3, seed=3)
            .mean()
            .sum()
        )
        assert total < last
        last = total
