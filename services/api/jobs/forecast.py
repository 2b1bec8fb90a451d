"""How long something will take, learned from how long it took before.

Pure; few observations make the range wide, not wrong. Logarithms of durations are taken as linear in what describes a
job: ``log T = a + x·b + e``, ``e`` normal. With a flat prior on ``a``, a normal one on ``b`` whose width goes with the
noise, the next duration's logarithm follows Student's t (the conjugate linear model; Gelman et al., Bayesian Data
Analysis, 14.2 and 14.8). A job that differs from all the earlier ones, or that follows few of them, so gets a wide
range by itself. What has lasted for some time already is conditioned on having done so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

SHARE = 0.8
"""Of all cases that a range is to hold."""
MIN_OBSERVATIONS = 5
"""Observations below which nothing is said."""
OUTLIVED = 0.02
"""Share of cases below which those that lasted as long are too few to learn from."""
SLOPE_VARIANCE = 25.0
"""Of each slope, over that of the noise: at a noise of 10 %, slopes within 0.5 of what was expected."""
NOISE = 0.1
"""Relative noise that is added with the weight of one observation, so that a few equal durations do not make a range of
no width."""

PERSISTENCE = 0.5
"""Expected share of the last case's surprise in the next one: a machine that others use too stays as busy for a
while."""


@dataclass(frozen=True)
class Observation:
    """One earlier case."""

    features: tuple[float, ...]
    """Logarithms of what describes it."""
    seconds: float


@dataclass(frozen=True)
class Outlook:
    """Distribution of a duration: its logarithm is Student's t."""

    centre: float
    """Logarithm of the median, in s."""
    spread: float
    degrees: int

    def remaining_s(self, elapsed_s: float = 0.0, share: float = SHARE) -> tuple[float, float] | None:
        """Range that holds what remains after ``elapsed_s`` in a share of all cases; None if too few cases last that
        long.
        """
        lasting = 1.0 if elapsed_s <= 0 else survival((math.log(elapsed_s) - self.centre) / self.spread, self.degrees)
        if lasting < OUTLIVED:
            return None
        low, high = (self._outlasted_by(lasting * (1 + sign * share) / 2) for sign in (1, -1))
        return max(low - max(elapsed_s, 0.0), 0.0), high - max(elapsed_s, 0.0)

    def _outlasted_by(self, share: float) -> float:
        return math.exp(min(self.centre + self.spread * _inverse_survival(share, self.degrees), 700.0))


def foresee(past: Sequence[Observation], features: Sequence[float], slopes: Sequence[float]) -> Outlook | None:
    """Outlook of a case with these features; None with fewer than ``MIN_OBSERVATIONS`` observations.

    Args:
        past: oldest first, as what was unexpected of one case is expected to go on in part in the next.
        slopes: expected ones, by how much log T grows with each feature.
    """
    if len(past) < MIN_OBSERVATIONS:
        return None
    x, y = np.array([one.features for one in past]), np.log([one.seconds for one in past])
    surprises = _regress(x, y, slopes).residuals
    before = np.concatenate([[0.0], surprises[:-1]])
    fit = _regress(np.column_stack([x, before]), y, (*slopes, PERSISTENCE))
    step = np.array([*features, surprises[-1]]) - fit.x_mean
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
    """P(T > t) of Student's t with a whole number of degrees of freedom (Abramowitz and Stegun, 26.7.3 and 26.7.4)."""
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
