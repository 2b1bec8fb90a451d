"""What the data fix, and how well: sandwich covariance, undetermined directions, derived quantities by the delta method.

Cov(x) = H^-1 (s J'W Sigma W J + C_mc + Lambda) H^-1 with H = J'WJ + Lambda; Sigma is the measurements' variance, s >= 1 the factor by which residuals
exceed it (model misfit), C_mc the Monte Carlo covariance of the final gradient and Lambda the weak prior's precision, which alone speaks in directions
where the data are silent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.core.records import Estimate
from services.fit.optics.domain import UNITS, Domain, kind_of, natural_derivative
from services.fit.optics.parameters import MEDIUM_FIELDS, Medium, Optics, Tissue
from services.fit.solve.normal_equations import NormalEquations

Array = NDArray[np.float64]

NOISE_FACTOR = 3.0
"""An eigenvalue below so many of its own standard deviations is not told from zero."""
LEAST_DATA_SHARE = 0.5
"""A parameter is determined where data, not prior, give at least this part of the information."""


DERIVED: Mapping[str, tuple[str, Callable[[Medium], float]]] = MappingProxyType(
    {
        "sigma_s_reduced": ("1/mm", lambda m: m.sigma_s_reduced),
        "sigma_a": ("1/mm", lambda m: (1 - m.alpha) * m.sigma),
        "alpha_reduced": ("1", lambda m: m.alpha_reduced),
        "mean_cosine": ("1", lambda m: m.mean_cosine),
    }
)
"""Quantities of a medium that are reported beside its parameters: unit and formula."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariance (F, F) of x, and the scaled directions (F, K) that the data leave open."""

    domain: Domain
    x: Array
    covariance: Array
    open_directions: Array
    posterior: Array
    """(J'WJ + Lambda)^-1, (F, F)."""

    def standard_error(self, slope: Array) -> float:
        """One standard error of a quantity with gradient ``slope`` (F,) to x."""
        return float(np.sqrt(max(float(slope @ self.covariance @ slope), 0.0)))

    def is_determined(self, slope: Array) -> bool:
        """Whether the data fix a quantity with gradient ``slope``: it avoids open directions and bounds, and the prior knows less than half."""
        _, precision = self.domain.prior
        scaled = slope * self.domain.scale
        size = float(scaled @ scaled)
        if size == 0.0:
            return False
        along_open = float(((self.open_directions.T @ scaled) ** 2).sum())
        low, high = self.domain.bounds
        on_bound = (self.x <= low) | (self.x >= high)

        # a'C Lambda C a / a'C a is the prior's share of the information: lambda / (d + lambda) for one coordinate.
        seen = self.posterior @ slope
        prior_share = float((precision * seen) @ seen) / max(float(slope @ seen), 1e-300)
        return along_open < 0.1 * size and float((scaled[on_bound] ** 2).sum()) < 0.1 * size and prior_share < 1 - LEAST_DATA_SHARE


def uncertainty(domain: Domain, x: Array, equations: NormalEquations) -> Uncertainty:
    """Uncertainty at a solution from the normal equations there."""
    _, precision = domain.prior
    scale = domain.scale
    misfit = max(1.0, equations.squares / equations.expected_squares) if equations.expected_squares > 0 else 1.0

    # Directions whose data curvature drowns in its own noise, in scaled coordinates.
    eigenvalues, vectors = np.linalg.eigh(equations.hessian * np.outer(scale, scale))
    noise = equations.eigenvalue_noise(scale[:, None] * vectors)
    is_open = eigenvalues < np.maximum(NOISE_FACTOR * noise, 1e-12 * abs(eigenvalues).max())

    # Curvature for the inverse: open directions keep only their noise level, so that they show a large error instead of a negative variance.
    believed = np.where(is_open, np.maximum(noise, 1e-12 * abs(eigenvalues).max() + 1e-300), eigenvalues)
    data = (vectors * believed) @ vectors.T
    prior = np.diag(precision * scale**2)
    inverse = np.linalg.pinv(data + prior, hermitian=True)
    meat = (misfit * _positive(equations.data_noise) + _positive(equations.gradient_noise)) * np.outer(scale, scale) + prior
    covariance = inverse @ meat @ inverse * np.outer(scale, scale)
    return Uncertainty(domain, x, 0.5 * (covariance + covariance.T), vectors[:, is_open], inverse * np.outer(scale, scale))


def estimates(tissue: Optics, parts: Iterable[str], known: Uncertainty | None, shape_known: Uncertainty | None = None) -> dict[str, Estimate]:
    """Every parameter of the named parts with unit, standard error and whether the data fix it, and the derived quantities.

    Args:
        tissue: the solution.
        parts: ``enamel``, ``dentin``, of a mouth ``3.enamel``, ``gums`` or ``cavity``; a single tooth's blend weights follow ``tissue.shape``.
        known: uncertainty of the coordinates that were fitted; None where nothing was.
        shape_known: uncertainty of the blend weights where another channel's fit gave them.
    """
    fitted = set(known.domain.parameters) if known is not None else set()
    out: dict[str, Estimate] = {}
    for part in parts:
        if part == "cavity":
            out["cavity.reflectance"] = _raw(tissue, "cavity.reflectance", known if "cavity.reflectance" in fitted else None)
            continue
        for leaf in MEDIUM_FIELDS:
            name = f"{part}.{leaf}"
            out[name] = _raw(tissue, name, known if name in fitted else None)
        for leaf, (unit, quantity) in DERIVED.items():
            out[f"{part}.{leaf}"] = _derived(tissue, known, part, quantity, unit)
    for k in range(len(tissue.shape) if isinstance(tissue, Tissue) else 0):
        name = f"shape.{k}"
        out[name] = _raw(tissue, name, known if name in fitted else shape_known)
    return out


def _raw(tissue: Optics, name: str, known: Uncertainty | None) -> Estimate:
    unit = UNITS[kind_of(name)]
    if known is None:
        return Estimate(value=tissue.value(name), se=None, unit=unit, determined=False)
    slope = np.zeros(len(known.x))
    for k, coordinate in enumerate(known.domain.coordinates):
        if name in coordinate.targets:
            slope[k] = natural_derivative(coordinate.kind, float(known.x[k]))
    return Estimate(value=tissue.value(name), se=known.standard_error(slope), unit=unit, determined=known.is_determined(slope))


def _derived(tissue: Optics, known: Uncertainty | None, part: str, quantity: Callable[[Medium], float], unit: str) -> Estimate:
    value = quantity(tissue.medium(part))
    if known is None:
        return Estimate(value=value, se=None, unit=unit, determined=False)
    # Central differences in the unbounded domain; the step is far below every scale and far above rounding.
    slope, step = np.zeros(len(known.x)), 1e-5
    for k, coordinate in enumerate(known.domain.coordinates):
        if any(target.startswith(f"{part}.") for target in coordinate.targets):
            shift = np.zeros(len(known.x))
            shift[k] = step
            high, low = (quantity(known.domain.tissue_at(known.x + sign * shift, tissue).medium(part)) for sign in (1, -1))
            slope[k] = (high - low) / (2 * step)
    if not slope.any():
        return Estimate(value=value, se=None, unit=unit, determined=False)
    return Estimate(value=value, se=known.standard_error(slope), unit=unit, determined=known.is_determined(slope))


def _positive(matrix: Array) -> Array:
    # A covariance estimated from products of two seeds may have slightly negative eigenvalues; a variance has none.
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
