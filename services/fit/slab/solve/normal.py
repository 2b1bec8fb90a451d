"""Normal equations from independent batches, so that no product is taken of an estimate with itself.

With C_b and J_b the images and derivatives of batch b of B, y the measurements and W their weights (``weights``), the pairs of
different batches give unbiased

    misfit   sum_ab (C_a - y) W (C_b - y),   gradient   sum_ab J_a^T W (C_b - y),   normal matrix   sum_ab J_a^T W J_b

each over a != b and divided by B (B - 1). One batch alone would add the power of its own noise to all three.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.fit.slab.model.dictionary import KNOTS, Material, tent_solid_angles
from services.fit.slab.model.forward import Batches
from services.fit.slab.solve.weights import Weights

Array = NDArray[np.float64]

UNKNOWNS = KNOTS + 1
"""What the forward model derives by: ln f at the knots, and sigma_a in per mm."""


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
    matrix_error: Array
    """Half the difference of the matrices of either half of the batches (U, U): about as far as ``matrix`` may be off by chance."""
    data_noise: Array
    """Covariance of the gradient's noise by the measurements (U, U)."""
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
            matrix_error=chain.T @ self.matrix_error @ chain,
            data_noise=chain.T @ self.data_noise @ chain,
        )


def derivative_rows(rows: Array, material: Material) -> Array:
    """Derivatives by ln f and sigma_a from sums of shares and ways (..., KNOTS + 1)."""
    ways = rows[..., KNOTS:]
    return np.concatenate([rows[..., :KNOTS] - ways * (material.scattering * tent_solid_angles()), -ways], axis=-1)


def normal_equations(batches: Batches, material: Material, values: Array, weights: Weights) -> NormalEquations:
    """Sums over all pixels that weigh; ``values`` (images, pixels)."""
    residuals = weights.whitened(batches.images - values).reshape(len(batches.images), -1)
    count = len(residuals)
    pairs = count * (count - 1)
    total = residuals.sum(axis=0)
    products = (total**2 - (residuals**2).sum(axis=0)) / pairs
    misfit = 0.5 * float(products.sum())

    # One pass sums the derivatives over each half of the batches, the second pairs each batch with the others.
    jacobians = [weights.whitened(derivative_rows(rows, material)[None])[0] for rows in batches.rows]
    middle = count // 2
    halves = [np.sum(half, axis=0).reshape(-1, UNKNOWNS) for half in (jacobians[:middle], jacobians[middle:])]
    summed = halves[0] + halves[1]
    whole = summed.T @ summed
    own = [np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((UNKNOWNS, UNKNOWNS))]
    own_data = np.zeros((UNKNOWNS, UNKNOWNS))
    terms = np.zeros((count, UNKNOWNS))
    for number, (term, residual, whitened) in enumerate(zip(terms, residuals, jacobians, strict=True)):
        jacobian = whitened.reshape(-1, UNKNOWNS)
        own[number >= middle] += jacobian.T @ jacobian
        scattered = weights.of_measurements(whitened[None])[0].reshape(-1, UNKNOWNS)
        own_data += scattered.T @ scattered
        term[:] = (jacobian.T @ (total - residual) + (summed - jacobian).T @ residual) / (count - 1)
    matrix = (whole - own[0] - own[1]) / pairs
    first, second = (
        (half.T @ half - alone) / max(size * (size - 1), 1)
        for half, alone, size in zip(halves, own, (middle, count - middle), strict=True)
    )
    gradient = terms.mean(axis=0) / 2
    # The gradient is a U-statistic of batches: its variance is that of a batch's part, twice the mean over its pairs.
    parts = terms - terms.mean(axis=0)
    gradient_noise = parts.T @ parts / pairs
    scattered = weights.of_measurements(sum(jacobians[1:], jacobians[0])[None])[0].reshape(-1, UNKNOWNS)

    # Noise of the misfit: that of the mean residual, and of the residuals' own products.
    variance = residuals.var(axis=0, ddof=1) / count
    misfit_se = float(np.sqrt((variance * (np.maximum(products, 0) + variance / 2)).sum()))
    return NormalEquations(
        misfit, misfit_se, gradient, matrix, gradient_noise, noise=whole / count**2 - matrix,
        noise_gradient=summed.T @ total / count**2 - gradient, used=int(weights.used.sum()), matrix_error=(first - second) / 2,
        data_noise=(scattered.T @ scattered - own_data) / pairs,
    )  # fmt: skip
