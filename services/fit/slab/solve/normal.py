"""Normal equations from independent batches, so that no product is taken of an estimate with itself.

With C_b and J_b the images and derivatives of batch b of B, y the measurements and W their weights, the pairs of different
batches give unbiased

    misfit   sum_ab (C_a - y) W (C_b - y),   gradient   sum_ab J_a^T W (C_b - y),   normal matrix   sum_ab J_a^T W J_b

each over a != b and divided by B (B - 1). One batch alone would add the power of its own noise to all three.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.fit.slab.model.dictionary import KNOTS, Material, tent_solid_angles
from services.fit.slab.model.forward import Batches

Array = NDArray[np.float64]

UNKNOWNS = KNOTS + 1
"""What the forward model derives by: ln f at the knots, and sigma_a in per mm."""
NEIGHBOURHOOD = 3
"""Edge in pixels of the square over which the Monte Carlo variance is smoothed."""


@dataclass(frozen=True)
class NormalEquations:
    """A quadratic model of half the misfit around one material, in U unknowns."""

    misfit: float
    """Half of the weighted squares, without the noise of the estimate."""
    misfit_se: float
    gradient: Array
    matrix: Array
    gradient_noise: Array
    """Covariance of the gradient's Monte Carlo noise (U, U), of rank B - 1."""
    noise: Array
    """Power of the Monte Carlo noise in the mean derivatives (U, U): what the matrix would have too much."""
    noise_gradient: Array
    """What the gradient would have too much if each batch met itself."""
    used: int
    """Number of pixels."""

    def chained(self, chain: Array | None) -> NormalEquations:
        """The same in other unknowns, by the derivatives (UNKNOWNS, U) of these; None leaves them as they are."""
        if chain is None:
            return self
        return replace(
            self,
            gradient=chain.T @ self.gradient,
            matrix=chain.T @ self.matrix @ chain,
            gradient_noise=chain.T @ self.gradient_noise @ chain,
            noise=chain.T @ self.noise @ chain,
            noise_gradient=chain.T @ self.noise_gradient,
        )


def derivative_rows(rows: Array, material: Material) -> Array:
    """Derivatives by ln f and sigma_a from sums of shares and ways (..., KNOTS + 1)."""
    ways = rows[..., KNOTS:]
    return np.concatenate([rows[..., :KNOTS] - ways * (material.scattering * tent_solid_angles()), -ways], axis=-1)


def smoothed_variance(images: Array, shape: tuple[int, int]) -> Array:
    """Monte Carlo variance of the mean of batches (B, images, pixels), smoothed over neighbours of one image.

    A pixel's own estimate is small where its value happens to be small, and weights that follow it pull the fit down.
    """
    batches, count, _ = images.shape
    variance = images.var(axis=0, ddof=1).reshape(count, *shape) / batches
    reach = NEIGHBOURHOOD // 2
    padded = np.pad(variance, ((0, 0), (reach, reach), (reach, reach)), mode="symmetric")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (NEIGHBOURHOOD, NEIGHBOURHOOD), axis=(1, 2))
    return np.asarray(windows.mean(axis=(-1, -2)).reshape(count, -1))


def normal_equations(batches: Batches, material: Material, values: Array, weights: Array) -> NormalEquations:
    """Sums over all pixels of positive weight; ``values`` and ``weights`` (images, pixels)."""
    used = weights > 0
    w, y = weights[used], values[used]
    residuals = batches.images[:, used] - y
    count = len(residuals)
    pairs = count * (count - 1)
    total = residuals.sum(axis=0)
    products = (total**2 - (residuals**2).sum(axis=0)) / pairs
    misfit = 0.5 * float(w @ products)

    # One pass sums the derivatives, the second pairs each batch with the others.
    jacobians = [derivative_rows(rows[used], material) for rows in batches.rows]
    summed = np.sum(jacobians, axis=0)
    together = summed * w[:, None]
    whole = together.T @ summed
    own = np.zeros((UNKNOWNS, UNKNOWNS))
    own_gradient = np.zeros(UNKNOWNS)
    terms = np.zeros((count, UNKNOWNS))
    for term, residual, jacobian in zip(terms, residuals, jacobians, strict=True):
        weighted = jacobian * w[:, None]
        own += weighted.T @ jacobian
        own_gradient += weighted.T @ residual
        term[:] = (weighted.T @ (total - residual) + (together - weighted).T @ residual) / (count - 1)
    matrix = (whole - own) / pairs
    gradient = terms.mean(axis=0) / 2
    # The gradient is a U-statistic of batches: its variance is that of a batch's part, twice the mean over its pairs.
    parts = terms - terms.mean(axis=0)
    gradient_noise = parts.T @ parts / pairs

    # Noise of the misfit: that of the mean residual, and of the residuals' own products.
    variance = residuals.var(axis=0, ddof=1) / count
    misfit_se = float(np.sqrt((w**2 * variance * (np.maximum(products, 0) + variance / 2)).sum()))
    return NormalEquations(
        misfit, misfit_se, gradient, matrix, gradient_noise, noise=whole / count**2 - matrix,
        noise_gradient=(together.T @ total) / count**2 - gradient, used=int(used.sum()),
    )  # fmt: skip
