"""The image error over mixtures of three phase functions: what counts as a second minimum."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from services.bench.slab.surface import COSINES, mixture_of, mixtures, other_minima

STEPS = 5


def rows(squared: dict[tuple[int, int, int], float], spread: float = 1e-6) -> list[dict[str, Any]]:
    """A surface that rises from the mixture (2, 2, 1) with the squared distance, except where ``squared`` sets it."""
    lowest = np.array([2, 2, 1])
    return [
        {
            "weights": tuple(part / STEPS for part in point),
            "squared": squared.get(point, 0.01 * float(((np.array(point) - lowest) ** 2).sum())),
            "squared_se": spread,
        }
        for point in mixtures(STEPS)
    ]


def test_a_bowl_has_one_minimum() -> None:
    assert other_minima(rows({})) == []


def test_a_second_hollow_is_found_unless_noise_explains_it() -> None:
    hollow = {(5, 0, 0): 0.001}
    (found,) = other_minima(rows(hollow))
    assert found["weights"] == (1.0, 0.0, 0.0)
    assert other_minima(rows(hollow, spread=0.1)) == []


def test_a_mixture_of_phase_functions_keeps_extinction_and_mixes_cosines() -> None:
    material = mixture_of((0.5, 0.25, 0.25), 3.0)
    assert material.extinction_per_mm == pytest.approx(3.0)
    # With knots 0.9 degrees apart, HG 0.8 becomes a little blunter.
    expected = 0.5 * COSINES[0] + 0.25 * COSINES[1] + 0.25 * COSINES[2]
    assert material.mean_cosine == pytest.approx(expected, abs=1e-3)
