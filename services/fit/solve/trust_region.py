"""The trust-region subproblem with a curvature that Monte Carlo noise may have made indefinite (Moré and Sorensen
1983).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.errors import NonFiniteError

Array = NDArray[np.float64]


class Noise(Protocol):
    """Noise of a curvature H (F, F)."""

    def variance(self, directions: Array) -> Array:
        """Variance of u'Hu for each column u of ``directions`` (F, K)."""


def solve_ball(hessian: Array, gradient: Array, radius: float, curvature_floor: Array | None = None) -> Array:
    """Step p (F,) that minimises g'p + p'Hp/2 over norm(p) <= radius, in coordinates scaled so that the region is a
    ball.

    Args:
        hessian: symmetric (F, F), may be indefinite.
        gradient: gradient g (F,).
        radius: largest length of the step, positive.
        curvature_floor: least curvature (F,) that is used in each eigendirection, in ascending order of H's
            eigenvalues: the noise level of the eigenvalue; None for zero.

    Raises:
        NonFiniteError: NaN or infinity in the input.
    """
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise NonFiniteError(
            f"The normal equations hold {np.count_nonzero(~np.isfinite(hessian))} non-finite entries; lower the sample"
            " noise or mask the pixels that cause it."
        )
    size = float(np.linalg.norm(gradient))
    if size == 0.0 or radius <= 0.0:
        return np.zeros_like(gradient)

    # Scale the numbers to order one, whatever the units of the loss.
    largest = max(float(np.abs(hessian).max()), size / radius)
    eigenvalues, vectors = np.linalg.eigh(hessian / largest)
    floor = np.zeros_like(eigenvalues) if curvature_floor is None else np.maximum(curvature_floor / largest, 0.0)
    slope = vectors.T @ (gradient / largest)

    # Raise curvature that is negative or below its noise to the noise; the least value is set by rounding alone.
    tiny = 1e-13 * max(1.0, float(np.abs(eigenvalues).max()))
    curvature = np.maximum(np.maximum(eigenvalues, floor), tiny)

    # Find one damping for all directions by bisection on the length of the step, which falls monotonically with the
    # damping.
    def length(damping: float) -> float:
        damped = slope / (curvature + damping)
        return math.sqrt(damped @ damped)

    if length(0.0) <= radius:
        return np.asarray(-vectors @ (slope / curvature))
    low, high = 0.0, float(np.linalg.norm(slope)) / radius
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if length(middle) > radius else (low, middle)
        if high - low <= 1e-12 * high:
            break
    return np.asarray(-vectors @ (slope / (curvature + high)))


def solve_box(
    hessian: Array,
    gradient: Array,
    x: Array,
    bounds: tuple[Array, Array],
    scale: Array,
    radius: float,
    hessian_noise: Noise | None = None,
) -> Array:
    """Step p (F,) from x with norm(p / scale) <= radius and x + p within bounds (an active-set method).

    Coordinates that would leave their bounds are set on the bound, and the others are solved again.

    Args:
        hessian: symmetric (F, F), may be indefinite.
        gradient: gradient (F,) at x.
        x: present point (F,).
        bounds: lower and upper bounds, (F,) each.
        scale: length scale (F,) of each coordinate, positive.
        radius: largest scaled length of the step.
        hessian_noise: noise of the curvature, which sets the least curvature that is used; None for exact curvature.
    """
    low, high = bounds
    step = np.zeros_like(x)
    free = np.ones(len(x), dtype=bool)
    for _ in range(len(x)):
        index = np.flatnonzero(free)
        if len(index) == 0:
            break
        fixed = np.flatnonzero(~free)
        s = scale[index]
        reduced = hessian[np.ix_(index, index)] * np.outer(s, s)
        slope = (gradient[index] + hessian[np.ix_(index, fixed)] @ step[fixed]) * s
        floor = None
        if hessian_noise is not None:
            vectors = np.linalg.eigh(reduced)[1] if np.isfinite(reduced).all() else np.eye(len(index))
            directions = np.zeros((len(x), len(index)))
            directions[index] = s[:, None] * vectors
            floor = np.sqrt(hessian_noise.variance(directions))
        room = max(radius**2 - float(((step[fixed] / scale[fixed]) ** 2).sum()), 0.0) ** 0.5
        step[index] = s * solve_ball(reduced, slope, room, floor)

        # Keep a coordinate free as long as its own step stays inside its bounds.
        target = x + step
        leaving = free & ((target < low) | (target > high))
        if not leaving.any():
            break
        step[leaving] = np.clip(target[leaving], low[leaving], high[leaving]) - x[leaving]
        free &= ~leaving
    return np.clip(x + step, low, high) - x
