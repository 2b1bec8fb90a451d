"""Predicts how long something takes from how long it took before; pure functions without I/O.

The logarithm of a duration is modelled as linear in the features of a job: ``log T = a + x·b + e`` with normal noise
``e``. With a flat prior on ``a`` and a normal prior on ``b`` whose width is proportional to the noise, the logarithm of
the next duration follows Student's t (the conjugate linear model; Gelman et al., Bayesian Data Analysis, 14.2 and
14.8). Few observations, or a job that differs from all earlier ones, therefore give a wide range and not a wrong one.
For a case that has lasted for some time already, the distribution is conditioned on that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

SHARE = 0.8
"""Share of all cases that a range is to contain."""
MIN_OBSERVATIONS = 5
"""Smallest number of observations from which something is predicted."""
OUTLIVED = 0.02
"""Survival probability of the elapsed time below which nothing is predicted, because too few cases last as long."""
SLOPE_VARIANCE = 25.0
"""Prior variance of each slope, relative to the variance of the noise: at a noise of 10 %, one standard deviation of a
slope is 0.5."""
NOISE = 0.1
"""Relative noise that is added with the weight of one observation, so that a few equal durations do not give a range of
width zero."""

PERSISTENCE = 0.5
"""Prior mean of the share of the last case's residual that recurs in the next case: a machine that others use too stays
as busy for a while."""


@dataclass(frozen=True)
class Observation:
    """Features and duration of one earlier case."""

    features: tuple[float, ...]
    """Logarithms of the quantities that describe the case."""
    seconds: float


@dataclass(frozen=True)
class Outlook:
    """Predictive distribution of a duration: its logarithm follows Student's t."""

    centre: float
    """Logarithm of the median, in s."""
    spread: float
    """Scale of Student's t."""
    degrees: int
    """Degrees of freedom."""

    def remaining_s(self, elapsed_s: float = 0.0, share: float = SHARE) -> tuple[float, float] | None:
        """Return the range in s that contains the remaining duration after ``elapsed_s`` in a ``share`` of all cases;
        None if too few cases last that long.
        """
        lasting = 1.0 if elapsed_s <= 0 else survival((math.log(elapsed_s) - self.centre) / self.spread, self.degrees)
        if lasting < OUTLIVED:
            return None
        low, high = (self._quantile_s(lasting * (1 + sign * share) / 2) for sign in (1, -1))
        return max(low - max(elapsed_s, 0.0), 0.0), high - max(elapsed_s, 0.0)

    def _quantile_s(self, share: float) -> float:
        return math.exp(min(self.centre + self.spread * _inverse_survival(share, self.degrees), 700.0))


def foresee(past: Sequence[Observation], features: Sequence[float], slopes: Sequence[float]) -> Outlook | None:
    """Predict the duration of a case with these features; None with fewer than ``MIN_OBSERVATIONS`` observations.

    Args:
        past: observations, oldest first, because a part of the residual of one case is expected to recur in the next.
        slopes: prior means of the slopes, by which log T grows with each feature.
    """
    if len(past) < MIN_OBSERVATIONS:
        return None
    x, y = np.array([one.features for one in past]), np.log([one.seconds for one in past])
    errors = _regress(x, y, slopes).residuals
    before = np.concatenate([[0.0], errors[:-1]])
    fit = _regress(np.column_stack([x, before]), y, (*slopes, PERSISTENCE))
    step = np.array([*features, errors[-1]]) - fit.x_mean
    variance = fit.squares / (len(past) - 1) * (1 + 1 / len(past) + step @ np.linalg.solve(fit.information, step))
    return Outlook(float(fit.y_mean + step @ fit.slope), math.sqrt(float(variance)), len(past) - 1)


@dataclass(frozen=True)
class _Regression:
    x_mean: Array
    y_mean: float
    information: Array
    slope: Array
    residuals: Array
    squares: float


def _regress(x: Array, y: Array, slopes: Sequence[float]) -> _Regression:
    expected, x_mean, y_mean = np.array(slopes), x.mean(axis=0), float(y.mean())
    x, y = x - x_mean, y - y_mean
    information = x.T @ x + np.eye(len(expected)) / SLOPE_VARIANCE
    slope = np.linalg.solve(information, x.T @ y + expected / SLOPE_VARIANCE)
    residuals: Array = y - x @ slope
    squares = NOISE**2 + np.sum(residuals**2) + np.sum((slope - expected) ** 2) / SLOPE_VARIANCE
    return _Regression(x_mean, y_mean, information, slope, residuals, float(squares))


def survival(t: float, degrees: int) -> float:
    """Return P(T > t) of Student's t with a whole number of degrees of freedom (Abramowitz and Stegun, 26.7.3 and
    26.7.4).
    """
    angle = math.atan2(t, math.sqrt(degrees))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    term = total = 0.0 if degrees == 1 else (math.cos(angle) if degrees % 2 else 1.0)
    for k in range(3 if degrees % 2 else 2, degrees - 1, 2):
        term *= square * (k - 1) / k
        total += term
    inside = 2 / math.pi * (angle + sine * total) if degrees % 2 else sine * total
    return (1 - inside) / 2


def _inverse_survival(share: float, degrees: int) -> float:
    low, high = -1.0, 1.0
    while survival(low, degrees) < share:
        low *= 2
    while survival(high, degrees) > share:
        high *= 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if survival(middle, degrees) > share else (low, middle)
    return (low + high) / 2
