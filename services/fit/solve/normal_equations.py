"""Unbiased normal equations from noisy Jacobians and images, with the noise of each sum.

Two independently seeded estimates j1, j2 of a derivative have the mean m = (j1 + j2) / 2 and the difference d = j1 -
j2. Then m m' - d d' / 4 is the symmetrised product of the two, unbiased for j j', and for any direction u the product
(u'j1)(u'j2) has the variance E[(u'm)^2 (u'd)^2] (m and d are uncorrelated; exact for Gaussian noise). So one pair of
estimates gives every sum of this module together with its own variance.

Where derivatives vary smoothly from pixel to pixel, most of their noise does not. With Q the projection of each light's
rows onto smooth functions of place, orthogonal under the weights, the sums use Qj in place of j: sum w Qj r = sum w j
Qr, and sum w Qj j' = sum w Qj Qj'. They are unbiased for the smooth part of j, so the gradient vanishes where that
of j does, whatever Q leaves out; and with K functions for N pixels, a share K / N of the noise of j remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.curvature_noise import CurvatureNoise, curvature_noise, per_pixel

Array = NDArray[np.float64]


MAX_NOISE_SHARE = 0.9
"""Largest share of a derivative's mean square that is taken for its known noise."""


CLIPPED, CLIPPINGS = 4.0, 3
"""Robust standard deviations at which a noisy derivative is clipped, and rounds of it. On the micro-CT incisor the
clipped curvature was 1.2 % less, and its weakest but one direction stood 4.2 and 4.7 times above its noise instead of
2.8 and 1.6 times."""
NORMAL_SD = 1.4826
"""Standard deviation of a normal value over the median of its distance from 0."""
SMALLEST_NORM = 1e-10
"""Least eigenvalue of the Gram matrix of smooth functions, over the largest, at which a combination of them counts: few
valid pixels do not tell all functions apart."""


@dataclass(frozen=True)
class NormalEquations:
    """Sums over measurements i with weights w: F = 1/2 sum w r^2, for coordinates x (F,)."""

    hessian: Array
    """sum w j j', (F, F), from two independent seeds; may be indefinite."""
    gradient: Array
    """sum w j r, (F,), with the residual from a third and a fourth seed."""
    hessian_noise: CurvatureNoise
    gradient_noise: Array
    """Monte Carlo covariance of the gradient, (F, F)."""
    data_noise: Array
    """Covariance (F, F) of the gradient by the noise of the measurements, J'W Sigma W J."""
    squares: float = 0.0
    """sum w (r^2 - its Monte Carlo variance)."""
    expected_squares: float = 0.0
    """sum w var_ref: the expectation of ``squares`` where the residuals are the measurements' noise alone."""
    carried: Array | float = 0.0
    """Step (F,) over which the gradient was carried by this curvature since it was measured, mean over its samples."""
    loss: float = 0.0
    """F where the residuals were rendered, by cells (``loss_change``); it does not move with the model."""
    loss_variance: float = 0.0
    """Monte Carlo variance of ``loss``."""

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def record(self) -> dict[str, Any]:
        """The sums as JSON values."""
        arrays = {f.name: np.asarray(getattr(self, f.name)).tolist() for f in fields(self) if f.name != "hessian_noise"}
        return arrays | {"hessian_noise": self.hessian_noise.record()}

    @staticmethod
    def of(record: dict[str, Any]) -> NormalEquations:
        """Normal equations from the JSON values of ``record``."""
        values: dict[str, Any] = {
            name: np.array(value) if isinstance(value, list) else value
            for name, value in record.items()
            if name != "hessian_noise"
        }
        return NormalEquations(**values, hessian_noise=CurvatureNoise.of(record["hessian_noise"]))

    def scaled(self, factor: float) -> NormalEquations:
        """The sums with every weight multiplied by ``factor``: sums scale with it, covariances with its square."""
        linear, quadratic = factor, factor**2
        return NormalEquations(
            self.hessian * linear,
            self.gradient * linear,
            self.hessian_noise.scaled(quadratic),
            self.gradient_noise * quadratic,
            self.data_noise * quadratic,
            self.squares * linear,
            self.expected_squares * linear,
            self.carried * linear,
            self.loss * linear,
            self.loss_variance * quadratic,
        )

    def without_noise(self, of_hessian: Array, of_data_noise: Array) -> NormalEquations:
        """The sums without what known noise of the last K derivatives adds to them, (K, K) each; at most
        ``MAX_NOISE_SHARE`` of any direction's curvature is taken away.
        """
        first = len(self.gradient) - len(of_hessian)
        own = self.hessian[first:, first:]
        values, vectors = np.linalg.eigh(0.5 * (own + own.T))
        used = values > 1e-12 * max(float(values.max()), 1e-300)
        root = vectors[:, used] * np.sqrt(values[used])
        whiten = vectors[:, used] / np.sqrt(values[used])
        shares, axes = np.linalg.eigh(whiten.T @ of_hessian @ whiten)
        kept = np.minimum(shares, MAX_NOISE_SHARE) / np.where(shares > 0, shares, 1.0)
        removed, ratio = (axes * np.minimum(shares, MAX_NOISE_SHARE)) @ axes.T, (axes * kept) @ axes.T
        hessian, noise = self.hessian.copy(), self.data_noise.copy()
        hessian[first:, first:] -= root @ removed @ root.T
        part = root @ ratio @ whiten.T
        noise[first:, first:] -= 0.5 * (part @ of_data_noise + of_data_noise @ part.T)
        return replace(self, hessian=hessian, data_noise=noise)

    def moved(self, step: Array) -> NormalEquations:
        """The quadratic model expanded at ``step`` (F,) from here; the curvature's noise adds to the gradient's."""
        noise = self.gradient_noise + self.hessian_noise.of_product(step)
        return replace(
            self, gradient=self.gradient + self.hessian @ step, gradient_noise=noise, carried=self.carried + step
        )

    def eigenvalue_noise(self, directions: Array) -> Array:
        """Standard deviation of u'Hu for each column u of ``directions`` (F, K)."""
        return np.sqrt(self.hessian_noise.variance(directions))


def smoothed(rows: Array, weight: Array, lights: int, functions: Array | None) -> Array:
    """The projection Q of rows (F, M), M = lights x pixels, light by light, onto smooth functions of the pixel.

    Args:
        functions: (K, pixels); None leaves the rows as they are.
    """
    if functions is None:
        return rows
    found, shape = np.empty_like(rows), (lights, functions.shape[1])
    for own, w, out in zip(
        np.moveaxis(rows.reshape(len(rows), *shape), 1, 0),
        weight.reshape(shape),
        np.moveaxis(found.reshape(len(rows), *shape), 1, 0),
        strict=True,
    ):
        values, vectors = np.linalg.eigh((functions * w) @ functions.T)
        used = values > SMALLEST_NORM * max(float(values.max()), 1e-300)
        basis = (vectors[:, used] / np.sqrt(values[used])).T @ functions
        out[:] = (own * w) @ basis.T @ basis
    return found


def without_outliers(rows: Array, weight: Array, lights: int, functions: Array | None) -> Array:
    """Noisy rows (F, M) whose distance from their smooth part is limited to ``CLIPPED`` robust standard deviations.

    Few paths behind a rough surface bring much of the light, and so a few pixels most of the noise, and most of its
    estimate. Rows are clipped before they are multiplied with residuals, which stay as they are.
    """
    if functions is None:
        return rows
    shape = lights, functions.shape[1]
    seen = weight.reshape(shape) > 0
    for _ in range(CLIPPINGS):
        part = smoothed(rows, weight, lights, functions)
        distance = (rows - part).reshape(len(rows), *shape)
        limit = np.full((len(rows), lights, 1), np.inf)
        for light in np.flatnonzero(seen.any(axis=1)):
            spread = np.median(np.abs(distance[:, light, seen[light]]), axis=1)
            limit[spread > 0, light, 0] = CLIPPED * NORMAL_SD * spread[spread > 0]
        rows = part + np.clip(distance, -limit, limit).reshape(rows.shape)
    return rows


Region = tuple[Sequence[int], NDArray[np.bool_]]
"""Coordinates on which some of the measurements depend, and the mask (M,) of these measurements, for the noise of the
curvature."""


def normal_equations(
    j1: Array,
    j2: Array,
    r1: Array,
    r2: Array,
    reference_variance: Array,
    weight: Array,
    lights: int = 1,
    regions: Sequence[Region] | None = None,
    exact: int = 0,
    alone: int = 0,
    functions: Array | None = None,
) -> NormalEquations:
    """Normal equations of one block of measurements.

    The images of a pixel under all lights, and their derivatives, come from the same walks, so their errors are
    correlated. The noise is therefore that of sums over the lights of a pixel; pixels are independent. With half
    differences d of J and s of r, the sum of w m r over a pixel's lights has the covariance [sum w m s][..]' + [sum w r
    d][..]' - [sum w d s][..]'; the last term corrects for a part that both of the first two contain.

    Args:
        j1, j2: derivatives (F, M) from two independent seeds.
        r1, r2: render minus reference (M,), from two other seeds.
        reference_variance: variance of the reference (M,).
        weight: (M,), 0 where a measurement does not count.
        lights: M = lights x pixels, light by light.
        regions: sets of coordinates and measurements that together cover all measurements; None for one region of all
            coordinates.
        exact: number of coordinates, the last of all, whose derivatives, such as those to a gain, come from the very
            renders of r1 and r2. Each of these derivatives is multiplied with the residual of the other render; their
            own noise in the curvature, far smaller than that of the other derivatives, is neglected.
        alone: number of exact coordinates, the last of all, that act on one photograph each, such as its shift. The
            noise of their entries with other coordinates is not kept: it takes from the curvature what one of a
            photograph's many pixels adds, and would take the square of their number in memory.
        functions: smooth functions (K, pixels) of the pixel that the derivatives follow; None for any derivatives.
    """
    noisy = len(j1) - exact
    j1, j2 = (
        np.concatenate([without_outliers(one[:noisy], weight, lights, functions), one[noisy:]]) for one in (j1, j2)
    )
    difference, residual, spread = j1 - j2, 0.5 * (r1 + r2), 0.5 * (r1 - r2)

    # The smooth part of noisy derivatives. Sums of it with anything are sums of the whole with the other's smooth part,
    # whose terms are independent from pixel to pixel: these give the noise.
    def smooth(rows: Array) -> Array:
        return np.concatenate([smoothed(rows[:noisy], weight, lights, functions), rows[noisy:]])

    mean, smooth_difference = smooth(0.5 * (j1 + j2)), smooth(difference)
    smooth_residual = smoothed(residual[None], weight, lights, functions)[0]

    # Curvature, and its noise from the products of mean and difference.
    weighted = weight * mean
    hessian = weighted @ mean.T - 0.25 * (weight * smooth_difference) @ smooth_difference.T
    regions = regions if regions is not None else ((range(noisy), np.ones(len(weight), dtype=bool)),)
    known = range(noisy, len(mean) - alone)
    beside = np.concatenate([mean[:noisy], smoothed(mean[noisy:], weight, lights, functions)])
    noise = [
        CurvatureNoise((curvature_noise(beside, difference, np.where(chosen, weight, 0.0), near, lights, known),))
        for near, chosen in regions
    ]

    # The gradient, and its noise summed pixel by pixel.
    by_image, by_jacobian, by_both = (
        per_pixel(terms, lights)
        for terms in (
            weighted * spread,
            0.5 * weight * difference * smooth_residual,
            0.5 * weight * smooth_difference * spread,
        )
    )
    sensor, gradient = weight**2 * reference_variance, weighted @ residual
    if exact:
        own = weight * difference[noisy:]
        gradient[noisy:] -= 0.5 * own @ spread
        by_image[noisy:] += per_pixel(0.5 * own * residual, lights)
        by_jacobian[noisy:], by_both[noisy:] = 0.0, 0.0
    return NormalEquations(
        hessian=hessian,
        gradient=gradient,
        hessian_noise=sum(noise[1:], start=noise[0]),
        gradient_noise=by_image @ by_image.T + by_jacobian @ by_jacobian.T - by_both @ by_both.T,
        data_noise=(sensor * mean) @ mean.T - 0.25 * (sensor * smooth_difference) @ smooth_difference.T,
        squares=float(weight @ (residual**2 - spread**2)),
        expected_squares=float(weight @ reference_variance),
    )


def pool(old: NormalEquations, old_samples: float, new: NormalEquations, new_samples: float) -> NormalEquations:
    """Mean of two independent estimates of the same normal equations, weighted by their samples.

    Both use the same measurements, so the measurements' own noise does not average out.
    """
    share = new_samples / (old_samples + new_samples)
    pooled = old.scaled(1 - share) + new.scaled(share)
    return replace(pooled, data_noise=(1 - share) * old.data_noise + share * new.data_noise)


@dataclass(frozen=True)
class LossChange:
    """Change of F = 1/2 sum w r^2 between two points that are rendered with the same two seeds, and its Monte Carlo
    variance.
    """

    change: float
    variance: float

    @property
    def se(self) -> float:
        """One standard error of ``change``."""
        return float(np.sqrt(self.variance))

    def __add__(self, other: LossChange) -> LossChange:
        return LossChange(self.change + other.change, self.variance + other.variance)


def loss_change(
    old1: Array,
    old2: Array,
    new1: Array,
    new2: Array,
    weight: Array,
    lights: int,
    cell: NDArray[np.int32] | None = None,
) -> LossChange:
    """Compare residuals (M,), M = lights x pixels, at two points. Indices 1 and 2 are independent seeds, each shared by
    both points (common random numbers).

    The loss is the product of two independent residuals, so Monte Carlo noise does not bias it. Its variance follows
    from the identity of this module, applied to the bilinear form n1 n2 - o1 o2, and is summed pixel by pixel, because
    the lights of a pixel share their walks.

    With few paths, the product of both seeds' noise is the largest part of the variance. Sums over cells instead of
    pixels, of the cells' mean residuals, keep changes that vary slowly from pixel to pixel, as those by parameters do;
    their share of that noise falls with the root of the number of pixels of a cell.

    Args:
        cell: index (N,) of each pixel's cell; None to treat each pixel alone.
    """
    if cell is not None:
        total = _by_cell(weight, cell, lights)
        old1, old2, new1, new2 = (
            _by_cell(weight * r, cell, lights) / np.where(total > 0, total, 1.0) for r in (old1, old2, new1, new2)
        )
        weight = total
    terms = weight * (new1 * new2 - old1 * old2)
    deviations = per_pixel(
        weight * 0.5 * ((new1 + new2) * (new1 - new2) - (old1 + old2) * (old1 - old2))[None], lights
    )[0]
    return LossChange(0.5 * float(terms.sum()), 0.25 * float(deviations @ deviations))


def _by_cell(terms: Array, cell: NDArray[np.int32], lights: int) -> Array:
    # Sums (lights x cells,) of terms (lights x pixels,), cell by cell under each light.
    return np.concatenate([np.bincount(cell, row) for row in terms.reshape(lights, -1)])
