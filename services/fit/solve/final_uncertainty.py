"""The final uncertainty estimate, made once where a fit ends: the solution's true response to the data, and the error
that held mean cosines g cause.

A fit with Jacobians J~ of similar media solves J~'W r(x) + Lambda (x - m) = 0, an estimating equation whose instruments
J~ are not the derivatives J of its images. Its solution responds to the data by M^-1 J~'W, M = J~'W J + Lambda, and not
by the inverse of J~'W J~ + Lambda (generalised method of moments, Hansen 1982). With another mean cosine of the media,
at equal reduced scattering and absorption, images change by dC and the solution by M^-1 J~'W dC.

All sums are in whitened coordinates y, x = T y, in which the usable curvature is the identity. There M = 1 + E. Exact
derivatives are noisy, and inverting a matrix amplifies its noise, so E is shrunk to the part that exceeds its noise:
with entries of variance tau^2 about 0, and noise variance v, E becomes E tau^2 / (tau^2 + v) (Efron and Morris 1973),
with tau^2 such that sum E^2 / (tau^2 + v) equals its expectation (Paule and Mandel 1982).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.curvature_noise import per_pixel
from services.fit.solve.normal_equations import smoothed, without_outliers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FinalSums:
    """Sums over measurements in whitened coordinates y (F,); the sums of blocks add."""

    gradient: Array
    """Gradient J~'W r (F,) of the data."""
    gradient_noise: Array
    """Monte Carlo covariance (F, F) of the gradient."""
    response: Array
    """J~'W J, (F, F)."""
    response_variance: Array
    """Monte Carlo variance of each entry, (F, F)."""
    shifts: Array
    """J~'W dC (K, F) for K changes of the media or the setup, each by one standard deviation of the held quantity."""
    shift_noise: Array
    """Monte Carlo covariance (K, F, F) of each shift."""

    def __add__(self, other: FinalSums) -> FinalSums:
        return FinalSums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def record(self) -> dict[str, Any]:
        """The sums as JSON values."""
        return {f.name: getattr(self, f.name).tolist() for f in fields(self)}

    @staticmethod
    def of(record: dict[str, Any]) -> FinalSums:
        """Sums from the JSON values of ``record``."""
        sums = FinalSums(**{name: np.array(value, dtype=np.float64) for name, value in record.items()})
        count = len(sums.gradient)
        return replace(
            sums, shifts=sums.shifts.reshape(-1, count), shift_noise=sums.shift_noise.reshape(-1, count, count)
        )

    def shift_covariance(self, chosen: Sequence[int], *, is_combined: bool) -> Array:
        """Covariance (F, F) of the gradient by the chosen changes: the sum over them of b b' - N, for a measured shift
        b with noise N, without its negative eigenvalues.

        A shift must not be shortened as a whole to its expected length without noise: it would lose as much along
        directions in which it is well known as along noisy ones.

        Args:
            is_combined: whether the solution is combined with the instrument's prior afterwards. The combination goes
                where measured effects are small, partly by chance, so in each direction the larger of the sum and of
                its expectation counts.
        """
        least = self.expected_shift_covariance(chosen) if is_combined else np.zeros_like(self.response)
        excess = -least
        for k in chosen:
            excess += np.outer(self.shifts[k], self.shifts[k]) - self.shift_noise[k]
        return np.asarray(least + positive_part(excess))

    def expected_shift_covariance(self, chosen: Iterable[int]) -> Array:
        """Covariance (F, F) of the gradient by the chosen changes, by which a combination of least variance is chosen.

        Chosen by b b', which is partly noise, the combination would avoid this direction, at an error far above the one
        it expects. So each term is the expectation of the true square given b and N. For a normal prior of variance
        tau^2 in every direction that is m m' + K N, m = K b, K = (1 + N / tau^2)^-1, with tau^2 as for the response.
        """
        total = np.zeros_like(self.response)
        for k in chosen:
            shift, noise = self.shifts[k], positive_part(self.shift_noise[k])
            between = _between_variance(shift, np.maximum(np.diag(noise), 1e-30))
            if between > 0:
                kept = np.linalg.inv(np.eye(len(shift)) + noise / between)
                total += np.outer(kept @ shift, kept @ shift) + kept @ noise
        return total


def positive_part(matrix: Array) -> Array:
    """The matrix without its negative eigenvalues, which a covariance estimated from products of two seeds may have
    although no true covariance has them.
    """
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def final_sums(
    whiten: Array,
    similar: tuple[Array, Array],
    exact: tuple[Array, Array],
    copied: NDArray[np.bool_],
    residuals: tuple[Array, Array],
    moved: Array,
    weight: Array,
    lights: int,
    errors: int = 0,
    functions: Array | None = None,
) -> FinalSums:
    """Closing sums of one block of measurements, M = lights x pixels.

    Args:
        whiten: T (F, F).
        similar: J~ (F, M) from two seeds.
        exact: J (F, M) from two further seeds.
        copied: mask (F,) of the rows of J that are not rendered but copied from J~.
        residuals: render minus reference (M,) from two further seeds.
        moved: changes dC of the render (K, 2, M), by change and seed.
        weight: weights (M,) of the measurements.
        lights: number of lights.
        errors: number of coordinates, the last of all, that are instrument errors; their derivatives come from the
            renders of the residuals, as in ``normal_equations``.
        functions: smooth functions (K, pixels) that J~ follows, as there.
    """
    is_error = np.arange(len(whiten)) >= len(whiten) - errors

    def clipped(pair: tuple[Array, Array]) -> list[Array]:
        rows = (without_outliers(one, weight, lights, functions) for one in pair)
        return [np.where(is_error[:, None], one, own) for one, own in zip(pair, rows, strict=True)]

    first, second = clipped(similar)
    exact_first, exact_second = clipped(exact)
    mean, spread = 0.5 * (first + second), 0.5 * (first - second)

    # The smooth part Q of the tissue's rows, and of what these are multiplied with where their noise is summed.
    def smooth(rows: Array) -> Array:
        return smoothed(rows, weight, lights, functions)

    def smooth_tissue(rows: Array) -> Array:
        return rows if functions is None else np.where(is_error[:, None], rows, smooth(rows))

    true, true_spread = 0.5 * (exact_first + exact_second), 0.5 * (exact_first - exact_second)
    true, true_spread = np.where(copied[:, None], mean, true), np.where(copied[:, None], spread, true_spread)
    own = np.where(copied[:, None], spread, 0.0)
    m, e, f, o = (whiten.T @ rows for rows in (smooth_tissue(mean), true, true_spread, own))
    d, smooth_d = (whiten.T @ rows for rows in (spread, smooth_tissue(spread)))

    # Derivatives with respect to errors share the noise of the residuals' renders; all others have independent noise.
    apart, shared = (whiten.T @ np.where(chosen[:, None], spread, 0.0) for chosen in (~is_error, is_error))
    smooth_apart = apart if functions is None else whiten.T @ np.where(is_error[:, None], 0.0, smooth(spread))

    # Products of J~ with a pair of renders summed over measurements, with their noise by pixels, as in the normal
    # equations.
    def with_noise(pair: tuple[Array, Array], is_residual: bool = False) -> tuple[Array, Array]:
        value, half = weight * 0.5 * (pair[0] + pair[1]), weight * 0.5 * (pair[0] - pair[1])
        common = shared if is_residual else np.zeros_like(shared)
        smooth_value = weight * smooth(0.5 * (pair[0] + pair[1])[None])
        first, second, both = (
            per_pixel(terms, lights) for terms in (m * half + common * value, apart * smooth_value, smooth_apart * half)
        )
        return m @ value - common @ half, first @ first.T + second @ second.T - both @ both.T

    gradient, gradient_noise = with_noise(residuals, is_residual=True)
    shifts = [with_noise((change[0], change[1])) for change in moved]

    # The response. Where J is copied from J~, both factors share their noise: its square is subtracted from the value,
    # and the variance counts both together.
    response = (weight * m) @ e.T - (weight * smooth_d) @ o.T
    variance = np.zeros_like(response)
    rendered, smooth_e = f - o, smooth(e)
    for a in range(len(m)):
        for terms, sign in ((m[a] * rendered, 1.0), (d[a] * smooth_e + m[a] * o, 1.0), (smooth_d[a] * rendered, -1.0)):
            variance[a] += sign * (per_pixel(weight * terms, lights) ** 2).sum(axis=1)
    return FinalSums(
        gradient=gradient,
        gradient_noise=gradient_noise,
        response=response,
        response_variance=np.maximum(variance, 0.0),
        shifts=np.array([shift for shift, _ in shifts]).reshape(-1, len(m)),
        shift_noise=np.array([noise for _, noise in shifts]).reshape(-1, len(m), len(m)),
    )


@dataclass(frozen=True)
class Response:
    """Response M = 1 + E in whitened coordinates: its inverse (F, F), and the variance (F, F) that remains in each
    entry of M.
    """

    inverse: Array
    variance: Array
    excess: Array
    """E (F, F) after shrinkage."""
    blurred: Array
    """Unit directions (F, K) of the tissue along which M is smaller than its noise, so that ``inverse`` has the noise
    level in its place."""
    blurring: Array
    """Noise level over M along each of them, (K,), above 1."""


def response(sums: FinalSums, prior: Array, relation: NDArray[np.int_], errors: int = 0) -> Response:
    """Shrink the measured response towards the identity, which is the response that the usable curvature implies.

    Images are linear in the instrument's errors, and derivatives by these are exact, so M = [1 + E, F; G, 1]. The
    whitened coordinates eliminate the errors by the equations that the solver pooled on its way. For the derivatives of
    these equations F and G are zero, and for those at the solution they are not.

    Args:
        sums: the final uncertainty estimate.
        prior: whitened precision T' Lambda T, which is added to the measured data.
        relation: kind of each entry (F, F); entries of one kind are assumed to have one variance tau^2.
        errors: number of coordinates, the last of all, that are instrument errors.
    """
    size = len(prior)
    tissue = size - errors
    excess = sums.response + prior - np.eye(size)
    excess[tissue:, tissue:] = 0.0
    noise = np.maximum(sums.response_variance, 1e-30)
    between = np.zeros_like(excess)
    for kind in np.unique(relation):
        same_kind = relation == kind
        between[same_kind] = _between_variance(excess[same_kind], noise[same_kind])
    shrunk, remaining = excess * between / (between + noise), noise * between / (between + noise)

    # The inverse by blocks. Singular values of the tissue's block are raised to the noise level, because noise alone
    # could have made smaller ones.
    own, across, along = shrunk[:tissue, :tissue], shrunk[:tissue, tissue:], shrunk[tissue:, :tissue]
    u, values, v = np.linalg.svd(np.eye(tissue) + own - across @ along)
    floor = max(2 * np.sqrt(tissue * float(remaining[:tissue, :tissue].mean())), 1e-6)
    of_tissue, is_blurred = v.T @ ((u / np.maximum(values, floor)).T), values < floor
    inverse = np.block(
        [
            [of_tissue, -of_tissue @ across],
            [-along @ of_tissue, np.eye(errors) + along @ of_tissue @ across],
        ]
    )
    blurred = np.concatenate([v.T[:, is_blurred], np.zeros((errors, int(is_blurred.sum())))])
    return Response(
        np.asarray(inverse), remaining, shrunk, blurred, floor / np.maximum(values[is_blurred], 1e-3 * floor)
    )


def _between_variance(values: Array, noise: Array) -> float:
    # Root tau^2 of sum values^2 / (tau^2 + noise) = count, which falls with tau^2, by bisection.
    squares = values**2

    def excess(between: float) -> float:
        return float((squares / (between + noise)).sum()) - values.size

    if excess(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(squares.max()) * values.size
    for _ in range(100):
        middle = 0.5 * (low + high)
        if middle in {low, high}:
            break
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return 0.5 * (low + high)
