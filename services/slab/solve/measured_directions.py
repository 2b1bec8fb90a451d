"""Directions of a noisy normal matrix that count as measured, and the two steps that use it: one of all unknowns, and
one along broad directions.

Among two hundred unknowns that are mostly noise some direction always looks measured: eigenvalues of the noise alone
reach far beyond the noise of any single direction. So a step of all unknowns is damped by all of the noise. Ten broad
directions, chosen before any image, are damped by their own noise only. In a thick cell one of these is sigma_s at a
constant sigma_s'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from services.slab.solve.prior import RIDGE, Quadratic

Array = NDArray[np.float64]

MIN_SIGNAL = 0.1
"""Smallest eigenvalue of the normal matrix, in units of the prior and of its own noise, at which a direction counts as
measured."""


STEP_ITERATIONS = 10
"""Number of iterations by which a step and the noise that its length makes agree; the second is within a few per cent
already."""


@dataclass(frozen=True)
class MeasuredDirections:
    """The directions that count as measured: columns V (U, K) with V^T reference V = 1, and reference V."""

    vectors: Array
    dual: Array
    signals: Array
    """Eigenvalue of the normal matrix in each direction, in units of the reference (K,)."""
    prior: Array
    """Precision of the prior, with a ridge so that it can be inverted (U, U)."""

    @property
    def curvature(self) -> Array:
        """The normal matrix of these directions alone (U, U)."""
        return np.asarray((self.dual * self.signals) @ self.dual.T)

    @property
    def total(self) -> Array:
        """The normal matrix of these directions and the prior together (U, U)."""
        return self.curvature + self.prior

    def projected(self, gradient: Array) -> Array:
        """The part of a gradient in these directions (U,)."""
        return np.asarray(self.dual @ (self.vectors.T @ gradient))

    def noise(self, covariance: Array) -> Array:
        """The part of a gradient's covariance (U, U) in these directions; an unbiased estimate may have slightly
        negative eigenvalues, which are set to zero because a variance has none.
        """
        values, axes = np.linalg.eigh(self.vectors.T @ covariance @ self.vectors)
        half = self.dual @ axes * np.sqrt(np.maximum(values, 0))
        return np.asarray(half @ half.T)


def measured_directions(quadratic: Quadratic, prior: Array) -> MeasuredDirections:
    """Find the directions of the normal matrix that stand out from its noise and a prior's precision (U, U)."""
    whole = prior + _ridge(quadratic)
    reference = whole + quadratic.noise
    signals, vectors = linalg.eigh(quadratic.matrix, reference)
    chosen = vectors[:, signals > MIN_SIGNAL]
    return MeasuredDirections(chosen, reference @ chosen, signals[signals > MIN_SIGNAL], whole)


def step_matrix(quadratic: Quadratic, prior: Array, damping: float) -> Array:
    """Matrix of the damped step (U, U): ``damping`` times the noise of J holds directions whose curvature may be
    noise.
    """
    return np.asarray(quadratic.matrix + prior + damping * quadratic.noise + _ridge(quadratic))


def broad_step(
    quadratic: Quadratic, prior: Array, broad: Array, deviations: Array, gradient_noise: Array, x: Array
) -> Array:
    """A second step (U,) from x, along broad directions alone and not damped by the noise of J.

    That noise adds up over all pixels, but the unbiased matrix is off by its fluctuation alone, which many pixels
    average. In a thick cell the direction of sigma_s at a constant sigma_s' has less signal than noise: damped by all
    of it, steps went a tenth of their way there, and fits ended with their budget. The two steps in turn are a two-grid
    cycle.

    The gradient is treated as a measurement g = -M d + noise of the displacement d to the minimum. In directions of
    signal s and unit noise of J an element of M is off by about h sqrt(1 + s_i + s_j), so an element of g has a
    variance of h^2 sum_j (1 + s_i + s_j) d_j^2 beside its own. With R the covariance of both, and T that of d
    beforehand, the most probable displacement has (M R^-1 M + T^-1 + prior) d = -M R^-1 g - prior x: all of it where
    signals stand out, none of it where they do not. As R depends on d, both are found by iteration.

    Args:
        broad: directions (U, K).
        deviations: standard deviations (K,) of the displacement along them.
        gradient_noise: covariance of the gradient (U, U).
    """
    if not broad.size:
        return np.zeros(len(x))
    noise_of_broad = broad.T @ (quadratic.noise + _ridge(quadratic)) @ broad
    eigenvalues, vectors = linalg.eigh(broad.T @ quadratic.matrix @ broad, noise_of_broad)
    axes = broad @ vectors
    signals = np.maximum(eigenvalues, 0)
    sums = 1 + signals[:, None] + signals
    h_squared = float(
        (np.abs(np.einsum("ik,ij,jk->k", axes, quadratic.error, axes, optimize=True)) ** 2 / np.diag(sums)).max()
    )

    noise, gradient = axes.T @ gradient_noise @ axes, axes.T @ (quadratic.linear + quadratic.matrix @ x)
    prior_precision = axes.T @ prior @ axes + vectors.T @ (vectors / deviations[:, None] ** 2)
    squares, displacement = np.zeros(len(signals)), np.zeros(len(signals))
    for _ in range(STEP_ITERATIONS):
        gain = signals[:, None] * np.linalg.inv(noise + np.diag(h_squared * sums @ squares))
        covariance = np.linalg.inv(gain * signals + prior_precision)
        displacement = -covariance @ (gain @ gradient + axes.T @ (prior @ x))
        squares = displacement**2 + np.diag(covariance)
    return np.asarray(axes @ displacement)


def noise_ratio(quadratic: Quadratic, prior: Array, gradient_noise: Array) -> float:
    """Ratio of the gradient's noise to that of images that fit, which is the normal matrix with its noise."""
    whole = quadratic.matrix + quadratic.noise
    total = whole + prior + _ridge(quadratic)
    both = np.linalg.solve(total, np.stack([gradient_noise, whole]))
    return float(np.trace(both[0]) / np.trace(both[1]))


def _ridge(quadratic: Quadratic) -> Array:
    size = len(quadratic.matrix)
    return np.asarray(RIDGE * float(np.abs(np.diag(quadratic.matrix)).max()) * np.eye(size))
