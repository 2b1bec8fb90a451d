"""Normal equations from independent batches, so that no product is taken of an estimate with itself.

With C_b and J_b the images and derivatives of batch b of B, y the measurements and W their weights (``weights``), the
pairs of different batches give unbiased

    misfit   sum_ab (C_a - y) W (C_b - y),   gradient   sum_ab J_a^T W (C_b - y),   normal matrix   sum_ab J_a^T W J_b

each over a != b and divided by B (B - 1). One batch alone would add the power of its own noise to all three.

Derivatives of E earlier batches with the same weights may be added: then J_a and J_b of the matrix run over all
batches, and so does J_a of the gradient, with the divisor B (B + E - 1). Their noise is independent of the present
images whatever medium they were taken at, so the gradient is still zero where images fit. In a thick cell most of its
noise is that of J times the residuals, and falls with E.

Residuals of nearby media may be added as well, because J carries them over to this medium: then the gradient is that at
the mean of all their media, with the divisor R (B + E - 1) for residuals of R batches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import KNOTS, Material, tent_solid_angles
from services.slab.cell.forward import Batches
from services.slab.solve.weights import Weights

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""A function like ``map``."""

UNKNOWNS = KNOTS + 1
"""Number of variables of the forward model's derivatives: ln f at the knots, and sigma_a in per mm."""


@dataclass(frozen=True)
class DerivativeSums:
    """Sums over batches of whitened derivatives, for each half of the batches."""

    halves: Array
    """Sums of the derivatives (2, images * pixels, UNKNOWNS)."""
    own: Array
    """Sums of each batch's J^T W J (2, UNKNOWNS, UNKNOWNS)."""
    counts: tuple[int, int]
    """Number of batches in each half."""

    def __add__(self, other: DerivativeSums) -> DerivativeSums:
        """Sums over both sets of batches."""
        first, second = (a + b for a, b in zip(self.counts, other.counts, strict=True))
        return DerivativeSums(self.halves + other.halves, self.own + other.own, (first, second))

    @property
    def count(self) -> int:
        """Number of batches."""
        return sum(self.counts)

    def matrix(self) -> Array:
        """The normal matrix, without the power of the derivatives' noise."""
        whole = self.halves.sum(axis=0)
        return _over_pairs(whole, self.own[0] + self.own[1], self.count)

    def matrix_error(self) -> Array:
        """See ``NormalEquations.matrix_error``."""
        first, second = (_over_pairs(*of) for of in zip(self.halves, self.own, self.counts, strict=True))
        return np.asarray((first - second) / 2)


def _over_pairs(summed: Array, own: Array, count: int) -> Array:
    """Mean of J_a^T W J_b over pairs of different batches."""
    return np.asarray((summed.T @ summed - own) / max(count * (count - 1), 1))


@dataclass(frozen=True)
class ResidualSums:
    """Sums over batches of whitened residuals, which may be of several media."""

    total: Array
    """Sum of the residuals (images * pixels,)."""
    products: Array
    """Sum of each batch's J^T W (C - y) (UNKNOWNS,)."""
    count: int
    place: Array
    """Mean of the media's ln f and sigma_a over the batches (UNKNOWNS,)."""

    def __add__(self, other: ResidualSums) -> ResidualSums:
        """Sums over both sets of batches."""
        count = self.count + other.count
        place = (self.count * self.place + other.count * other.place) / count
        return ResidualSums(self.total + other.total, self.products + other.products, count, place)


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
    """Power of the Monte Carlo noise in the mean derivatives (U, U), by which the matrix of the mean derivatives is too
    large."""
    noise_gradient: Array
    """Excess of the gradient of the mean derivatives and mean residuals, in which each batch also meets itself (U,)."""
    matrix_error: Array
    """Half the difference of the matrices of the two halves of the batches (U, U): about the error of ``matrix`` by
    chance."""
    data_noise: Array
    """Covariance of the gradient's noise by the measurements (U, U)."""
    used: int
    """Number of values that have weight."""
    derivatives: DerivativeSums
    """Sums of derivatives with respect to ln f and sigma_a, whatever the unknowns are; later equations of the same
    weights may add them."""
    residuals: ResidualSums
    """Sums of residuals, likewise; the gradient is that at their ``place``."""

    def chained(self, chain: Array | None) -> NormalEquations:
        """The same equations in other unknowns, by the derivatives (UNKNOWNS, U) of ln f and sigma_a with respect to
        these; None leaves the equations as they are.
        """
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


def derivative_rows(rows: Floats, material: Material) -> Array:
    """Derivatives with respect to ln f and sigma_a from sums of shares and path lengths (..., KNOTS + 1)."""
    lengths = rows[..., KNOTS:].astype(np.float64)
    derivatives = np.empty(rows.shape)
    np.subtract(rows[..., :KNOTS], lengths * (material.scattering * tent_solid_angles()), out=derivatives[..., :KNOTS])
    derivatives[..., KNOTS:] = -lengths
    return derivatives


def _summed(arrays: Sequence[Array]) -> Array:
    """Sum of arrays, one after the other: stacked as for ``np.sum`` they would be copied first."""
    total = arrays[0].copy()
    for array in arrays[1:]:
        total += array
    return total


def normal_equations(
    batches: Batches,
    material: Material,
    values: Array,
    weights: Weights,
    earlier: DerivativeSums | None = None,
    nearby: ResidualSums | None = None,
    each: Each = map,
) -> NormalEquations:
    """Normal equations from all pixels that have weight.

    Args:
        values: measurements (images, pixels).
        earlier: derivatives of earlier batches, whitened by the same weights.
        nearby: residuals of some of these batches, of nearby media.
        each: function that works on batch after batch, such as that of a pool of threads.
    """
    residuals = weights.whitened(batches.images - values).reshape(len(batches.images), -1)
    count = len(residuals)
    pairs = count * (count - 1)
    total = residuals.sum(axis=0)
    products = (total**2 - (residuals**2).sum(axis=0)) / pairs
    misfit = 0.5 * float(products.sum())

    # One pass sums the derivatives over each half of the batches, the second pairs each batch with the others.
    jacobians = list(each(lambda rows: weights.whitened(derivative_rows(rows, material)[None])[0], batches.rows))
    middle = count // 2
    in_halves = jacobians[:middle], jacobians[middle:]
    halves = np.stack([half.reshape(-1, UNKNOWNS) for half in each(_summed, in_halves)])
    before = np.zeros_like(halves[0]) if earlier is None else earlier.halves.sum(axis=0)
    others = count - 1 + (0 if earlier is None else earlier.count)
    whole = halves.sum(axis=0) + before

    def products_of(batch: int) -> tuple[Array, Array, Array, Array]:
        jacobian, residual = jacobians[batch].reshape(-1, UNKNOWNS), residuals[batch]
        scattered = weights.of_measurements(jacobians[batch][None])[0].reshape(-1, UNKNOWNS)
        own_product = jacobian.T @ residual
        term = (jacobian.T @ total - 2 * own_product + whole.T @ residual) / others
        return jacobian.T @ jacobian, scattered.T @ scattered, own_product, term

    squares, data_squares, own_products, each_term = zip(*each(products_of, range(count)), strict=True)
    own, own_data = np.stack([_summed(squares[:middle]), _summed(squares[middle:])]), _summed(data_squares)
    terms = np.stack(each_term)
    present = DerivativeSums(halves, own, (middle, count - middle))
    every = present if earlier is None else earlier + present
    matrix = every.matrix()
    place = np.append(np.log(material.scattering), material.absorption_per_mm)
    sums = ResidualSums(total, _summed(own_products), count, place)
    sums = sums if nearby is None else sums + nearby
    gradient = (whole.T @ sums.total - sums.products) / (sums.count * others)
    # The gradient is a U-statistic of batches: its variance is that of a batch's part, twice the mean over its pairs.
    parts = terms - terms.mean(axis=0)
    gradient_noise = parts.T @ parts / pairs * (count / sums.count)
    # The noise of earlier derivatives meets that of the measurements alike in all batches, so their spread does not
    # show it: it is added here.
    scattered = weights.of_measurements(whole.reshape(jacobians[0].shape)[None])[0].reshape(-1, UNKNOWNS)
    mean = whole / every.count

    # Estimate the noise of the misfit: that of the mean residual, and of the residuals' own products.
    variance = residuals.var(axis=0, ddof=1) / count
    misfit_se = float(np.sqrt((variance * (np.maximum(products, 0) + variance / 2)).sum()))
    return NormalEquations(
        misfit, misfit_se, gradient, matrix, gradient_noise, noise=mean.T @ mean - matrix,
        noise_gradient=mean.T @ sums.total / sums.count - gradient, used=int(weights.used.sum()),
        matrix_error=every.matrix_error(), data_noise=(scattered.T @ scattered - own_data) / (every.count**2 - count),
        derivatives=every, residuals=sums,
    )  # fmt: skip
