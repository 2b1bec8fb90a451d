"""Judgement of Monte Carlo results by their z-scores against a truth, with stated false-alarm rates.

The rule for every table: the standard error is at most a third of the tolerance, |z| <= 4.5 for each value (one false
alarm in 150,000 values), and the rms z lies between 0.8 and 1.25. With few values the rms of correct results varies
more; then the bounds are those that chi-square exceeds with probability 1e-3.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

LARGEST_Z = 4.5
RMS_FALSE_ALARM = 1e-3


def rms_bounds(independent: int, rule: tuple[float, float] = (0.8, 1.25)) -> tuple[float, float]:
    """Bounds on the rms of z-scores.

    Args:
        independent: number of independent values; where it is small, the bounds are wider than the rule.
        rule: bounds for many values.
    """
    tails = stats.chi2.ppf([RMS_FALSE_ALARM / 2, 1 - RMS_FALSE_ALARM / 2], independent) / independent
    return min(rule[0], math.sqrt(tails[0])), max(rule[1], math.sqrt(tails[1]))


def z_scores(values: ArrayLike, truth: ArrayLike, standard_errors: ArrayLike) -> NDArray[np.float64]:
    """z-scores (N,) of all values. Exact values (zero standard error, no difference) have no score and are left out."""
    values, truth, errors = (np.asarray(a, dtype=np.float64).ravel() for a in (values, truth, standard_errors))
    exact = (errors == 0) & (values == truth)
    assert (errors[~exact] > 0).all(), "a value without spread differs from the truth"
    return (values[~exact] - truth[~exact]) / errors[~exact]


def require_unbiased(scores: ArrayLike, independent: int) -> None:
    """Assert that z-scores are compatible with noise alone; ``independent`` is the number of separate simulations."""
    scores = np.asarray(scores, dtype=np.float64)
    assert np.isfinite(scores).all()
    assert np.abs(scores).max() <= LARGEST_Z
    low, high = rms_bounds(independent)
    assert low <= np.sqrt(np.mean(scores**2)) <= high


def student_to_normal(t: ArrayLike, freedom: ArrayLike) -> NDArray[np.float64]:
    """Map values of Student's t to those of a standard normal with equal probability of the tail beyond."""
    t = np.asarray(t, dtype=np.float64)
    return np.copysign(stats.norm.isf(stats.t.sf(np.abs(t), freedom)), t)
