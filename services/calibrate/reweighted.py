"""Levenberg–Marquardt with Huber's weights, for some hundreds of unknowns and thousands of residuals.

SciPy's trust-region solver took 10 to 50 times as long on the same problems with a robust loss, because it rescales
rows by the loss's second derivative, which is 0 beyond the threshold, and makes little progress there. Iteratively
reweighted least squares does not have this problem (Holland & Welsch 1977).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-4, 1e-12, 1e8
"""Damping of the first step, and its smallest and largest value, as a fraction of each unknown's own curvature (the
diagonal of the normal matrix)."""
DAMPING_STEP = 10.0
"""Factor by which the damping falls after a step that lowers the cost, and rises after one that does not."""
SMALL_DECREASE = 1e-9
"""Relative decrease of the cost below which the iteration ends. With R residuals of one σ each, a step that gains less
moves no unknown by more than √(10⁻⁹ R) of its standard error: 0.003 of it for 9,000 residuals."""


def solve_reweighted(
    residuals: Callable[[Floats], Floats],
    derivative: Callable[[Floats], Floats],
    start: Floats,
    huber: float | None = None,
    max_steps: int = 60,
) -> Floats:
    """Return the unknowns (P,) that minimise the sum of squared, or of Huber's loss of, the residuals (R,).

    Args:
        residuals: function from the unknowns (P,) to the residuals (R,), in units of their σ.
        derivative: function from the unknowns (P,) to the residuals' derivative (R, P).
        start: first guess of the unknowns (P,).
        huber: threshold in σ beyond which the loss grows linearly with the residual instead of quadratically; None for
            plain least squares.
        max_steps: largest number of steps; after them the best unknowns so far are returned.
    """
    values, damping = start, FIRST_DAMPING
    off = residuals(values)
    for _ in range(max_steps):
        weights = _weights(off, huber)
        slope = derivative(values)
        normal, side = slope.T @ (weights[:, None] * slope), slope.T @ (weights * off)
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
        scaled = normal * np.outer(scale, scale)
        before, decrease = _cost(off, huber), 0.0
        # Raise the damping until a step lowers the cost. If none does even with the largest damping, the unknowns are
        # as good as rounding lets them be.
        while damping <= MAX_DAMPING:
            step = -scale * np.linalg.solve(scaled + damping * np.eye(len(values)), scale * side)
            new_off = residuals(values + step)
            decrease = before - _cost(new_off, huber)
            if decrease >= 0:
                values, off, damping = values + step, new_off, max(damping / DAMPING_STEP, MIN_DAMPING)
                break
            damping *= DAMPING_STEP
        if decrease <= SMALL_DECREASE * before:
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
