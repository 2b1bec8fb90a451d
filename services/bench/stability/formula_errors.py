"""Errors of the kernels' formulas in single precision, and of the fit's coordinates in double precision, against
independent forms in NumPy float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.bench.stability.corners import REGIONS, SMOOTH, Corners
from services.fit.coordinates.domain import BOUNDS, natural_derivative, to_dual, to_natural
from services.transport.optics import fresnel, phase
from services.transport.optics.free_flight import minus_log1m, one_minus_exp
from services.transport.scene.media import Media

Floats = NDArray[np.float64]
ROUNDING = 2.0**-24
"""Half a unit in the last place of single precision."""
DARK = 40.0
"""Optical depth, and exponent of a power of the albedo, beyond which the result is too small to compare."""


@dataclass(frozen=True)
class Formula:
    """A formula with the measurement of its error and the error's bound."""

    name: str
    relative_error: Callable[[Corners, np.random.Generator], Floats]
    """Function that returns the relative errors (N,) for the sets, each at one random argument."""
    bound: float
    """Largest allowed relative error."""
    reason: str
    """Origin of the bound."""


def kernel(function: Callable[..., Any], *columns: Floats) -> Floats:
    """Return the values of a kernel function; its arguments must be representable in single precision."""
    return np.array(function(*(mi.Float(column.astype(np.float32)) for column in columns)), dtype=np.float64)


def single(values: Floats) -> Floats:
    """Round values to single precision, as a kernel's arguments are."""
    return values.astype(np.float32).astype(np.float64)


def _deviations(corners: Corners, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the mean cosine g of the first layer's first lobe, and random deviations 1 - sign(g) cos(theta), from the
    peak of the lobe to the opposite direction.
    """
    g = single(corners.g1[0])
    return g, single(np.minimum((1 - np.abs(g)) ** 2 * 10.0 ** rng.uniform(-3, 9, len(g)), 2.0))


def _lobe(g: Floats, m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return |g|, 1 + g^2 - 2 |g| (1 - m) and the Henyey-Greenstein phase function at deviation m."""
    a = np.abs(g)
    d = (1 - a) ** 2 + 2 * a * m
    return a, d, (1 - a**2) / (4 * np.pi * d**1.5)


def phase_density(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the relative errors of the phase function's density."""
    g, m = _deviations(corners, rng)
    truth = _lobe(g, m)[2]
    return np.abs(kernel(phase.density, g, m) / truth - 1)


def phase_score(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the errors of the derivative of the density's logarithm with respect to g, relative to the size of its two
    terms, because their difference passes through zero.
    """
    g, m = _deviations(corners, rng)
    a, d, _ = _lobe(g, m)
    truth = np.copysign(1.0, g) * (-2 * a / (1 - a**2) + 3 * (1 - a - m) / d)
    size = 2 * a / (1 - a**2) + 3 * (1 - a + m) / d
    return np.abs(kernel(phase.score_g, g, m) - truth) / size


def phase_sampling(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the relative errors of the sampled deviation, by way of the cumulative distribution that it inverts."""
    g = single(corners.g1[0])
    u = single(np.where(rng.random(len(g)) < 0.5, rng.random(len(g)), 1 - 10.0 ** rng.uniform(-7, 0, len(g))))
    u = np.minimum(u, 1 - ROUNDING)
    m = kernel(phase.sample_deviation, g, u)
    a, d, value = _lobe(g, m)
    root = np.sqrt(d)
    below = (1 + a) * m / (root * (root + 1 - a))
    return np.abs(below - (1 - u)) / (2 * np.pi * value * np.maximum(m, 1e-300))


def fresnel_reflectance(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the errors of the Fresnel reflectance, relative to its value plus its change by one rounding of the index,
    which is large next to the critical angle.
    """
    eta = single(np.where(corners.boundary == SMOOTH, 1 / corners.ior, corners.ior))
    cosine = single(np.where(rng.random(len(eta)) < 0.5, rng.random(len(eta)), 10.0 ** rng.uniform(-6, 0, len(eta))))

    def truth(eta: Floats) -> Floats:
        beyond = np.sqrt((1 - (1 - cosine**2) / eta**2).astype(complex))
        s, p = (cosine - eta * beyond) / (cosine + eta * beyond), (eta * cosine - beyond) / (eta * cosine + beyond)
        return np.asarray((np.abs(s) ** 2 + np.abs(p) ** 2) / 2)

    right = truth(eta)
    steepness = np.abs(truth(eta * (1 + ROUNDING)) - truth(eta * (1 - ROUNDING))) / ROUNDING
    differs = eta != 1
    return np.abs(kernel(fresnel.reflectance, cosine, eta) - np.where(differs, right, 0)) / np.where(
        differs, right + steepness, 1
    )


def _depths(corners: Corners) -> Floats:
    """Return the optical depths (N,) of the first layer."""
    return single(corners.sigma[0] * corners.width_mm[0])


def collision(corners: Corners, rng: np.random.Generator) -> Floats:  # noqa: ARG001 - all formulas are called alike
    """Return the relative errors of 1 - exp(-depth), the probability of a collision."""
    depth = _depths(corners)
    return np.abs(kernel(one_minus_exp, depth) / -np.expm1(-depth) - 1)


def free_flight(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the relative errors of the optical depth to a collision that is forced to happen within the layer."""
    chance = single(-np.expm1(-_depths(corners)) * single(rng.random(len(corners))))
    chance = np.clip(chance, 1e-30, 1 - ROUNDING)
    return np.abs(kernel(minus_log1m, chance) / -np.log1p(-chance) - 1)


def transmittance(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the relative errors of the transmittance through both layers; 0 where the optical depth exceeds ``DARK``,
    because such rays are ended.
    """
    lengths = [single(width / rng.uniform(0.01, 1, len(corners))) for width in corners.width_mm]
    sigma = [single(values) for values in corners.sigma]
    depth = sigma[0] * lengths[0] + sigma[1] * lengths[1]
    ours = kernel(lambda a, b, c, d: dr.exp(-dr.fma(c, d, a * b)), sigma[0], lengths[0], sigma[1], lengths[1])
    return np.where(depth < DARK, np.abs(ours / np.exp(-np.minimum(depth, DARK)) - 1), 0)


def albedo_power(corners: Corners, rng: np.random.Generator) -> Floats:
    """Return the relative errors of alpha^n after n = 1 to 1e7 scatterings; 0 where it is below exp(-``DARK``), because
    no path continues with so little weight.
    """
    count = np.floor(10.0 ** rng.uniform(0, 7, len(corners)))
    log_alpha = Media(corners.media()).log_alpha[0]
    ours = np.array(dr.exp(mi.Float(count.astype(np.float32)) * log_alpha), dtype=np.float64)
    absorbed = corners.absorbed[0]
    exponent = single(count) * np.where(absorbed < 1, np.log1p(-np.minimum(absorbed, 0.999999999)), -np.inf)
    return np.where(exponent > -DARK, np.abs(ours / np.exp(np.maximum(exponent, -DARK)) - 1), 0)


def dual_domain(corners: Corners, rng: np.random.Generator) -> Floats:  # noqa: ARG001 - all formulas are called alike
    """Return the largest relative errors of the conversion to fit coordinates and back, and of the chain-rule factors;
    values outside the fit's bounds are clipped to them.
    """
    worst = np.zeros(len(corners))
    values = {"sigma": corners.sigma[0], "alpha": 1 - corners.absorbed[0], "g1": corners.g1[0], "beta": corners.beta[0]}
    for kind, natural in values.items():
        low, high = BOUNDS[kind]
        x = np.array([to_dual(kind, value) for value in natural.tolist()])
        back = np.array([to_natural(kind, value) for value in x.tolist()])
        slope = np.array([natural_derivative(kind, value) for value in x.tolist()])
        truth, slope_truth = _dual_truth(kind, x)
        inside = (x > low) & (x < high)
        for ours, right in ((back, truth), (slope, slope_truth), (np.where(inside, back, natural), natural)):
            worst = np.maximum(worst, np.abs(ours - right) / np.maximum(np.abs(right), 1e-300))
    return worst


def _dual_truth(kind: str, x: Floats) -> tuple[Floats, Floats]:
    """Return natural values and their derivatives with respect to x, computed without the hyperbolic and logistic
    functions.
    """
    small = np.exp(-(2 if kind == "g1" else 1) * np.abs(x))
    if kind == "sigma":
        return np.exp(x), np.exp(x)
    if kind == "alpha":
        absorbed = np.exp2(-x * np.log2(10.0))
        return 1 - absorbed, np.log(10.0) * absorbed
    if kind == "g1":
        return np.copysign(-np.expm1(-2 * np.abs(x)) / (1 + small), x), 4 * small / (1 + small) ** 2
    return np.where(x < 0, small, 1.0) / (1 + small), small / (1 + small) ** 2


FORMULAS = (
    Formula("phase density", phase_density, 20 * ROUNDING, "a dozen roundings, one of them to the power 3/2"),
    Formula("phase score", phase_score, 20 * ROUNDING, "a dozen roundings"),
    Formula("phase sampling", phase_sampling, 20 * ROUNDING, "a dozen roundings"),
    Formula("Fresnel", fresnel_reflectance, 20 * ROUNDING, "a dozen roundings"),
    Formula(
        "1 - exp(-x)",
        collision,
        40 * ROUNDING,
        "2 roundings of exp, magnified 20-fold at x = 0.05 where the series ends",
    ),
    Formula(
        "-log(1 - p)",
        free_flight,
        100 * ROUNDING,
        "1 rounding of 1 - p and 1 of log, magnified 50-fold at p = 0.02 where the series ends",
    ),
    Formula("transmittance", transmittance, 3 * DARK * ROUNDING, "3 roundings of a depth of up to 40"),
    Formula("albedo power", albedo_power, 3 * DARK * ROUNDING, "3 roundings of an exponent of up to 40"),
    Formula(
        "dual domain",
        dual_domain,
        20 * 2.0**-53 * np.log(1e16),
        "float64: a dozen roundings of numbers and of exponents up to 16 ln 10",
    ),
)


def worst_by_region(corners: Corners, seed: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return the largest relative errors of the finite values, and the numbers of values that are not finite, both
    (formulas, regions).
    """
    rng = np.random.default_rng(seed)
    worst, broken = np.zeros((len(FORMULAS), len(REGIONS))), np.zeros((len(FORMULAS), len(REGIONS)), dtype=np.int64)
    for row, formula in enumerate(FORMULAS):
        error = formula.relative_error(corners, rng)
        finite = np.isfinite(error)
        for column in range(len(REGIONS)):
            here = corners.region == column
            worst[row, column] = np.max(error[here & finite], initial=0)
            broken[row, column] = np.count_nonzero(here & ~finite)
    return worst, broken
