"""Parameters and quantities derived from them as they are reported: value, standard error, whether data fix it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.core.results import Estimate
from services.fit.optics.domain import UNITS, kind_of, natural_derivative
from services.fit.optics.parameters import MEDIUM_FIELDS, Medium, Optics, Tissue
from services.fit.solve.covariance import MIN_DATA_SHARE, Uncertainty

Array = NDArray[np.float64]
DERIVED: Mapping[str, tuple[str, Callable[[Medium], float]]] = MappingProxyType(
    {
        "sigma_s_reduced": ("1/mm", lambda m: m.sigma_s_reduced),
        "sigma_a": ("1/mm", lambda m: (1 - m.alpha) * m.sigma),
        "alpha_reduced": ("1", lambda m: m.alpha_reduced),
        "mean_cosine": ("1", lambda m: m.mean_cosine),
    }
)
"""Quantities of a medium that are reported beside its parameters: unit and formula."""


def estimates(
    tissue: Optics, parts: Iterable[str], known: Uncertainty | None, shape_known: Uncertainty | None = None
) -> dict[str, Estimate]:
    """Every parameter of the named parts with unit, standard error and whether the data fix it, and the derived
    quantities.

    Args:
        tissue: the solution.
        parts: ``enamel``, ``dentin``, ``shape``, of a mouth ``3.enamel``, ``3.shape``, ``gums`` or ``cavity``.
        known: uncertainty of the coordinates that were fitted; None where nothing was.
        shape_known: uncertainty of the blend weights where another channel's fit gave them.
    """
    fitted = set(known.domain.parameters) if known is not None else set()
    out: dict[str, Estimate] = {}
    for part in parts:
        if part == "cavity":
            out["cavity.reflectance"] = _raw(
                tissue, "cavity.reflectance", known if "cavity.reflectance" in fitted else None
            )
            continue
        if part.rpartition(".")[2] == "shape":
            names = [f"{part}.{k}" for k in range(len(_weights(tissue, part)))]
            out |= {name: _raw(tissue, name, known if name in fitted else shape_known) for name in names}
            continue
        for leaf in MEDIUM_FIELDS:
            name = f"{part}.{leaf}"
            if f"{part}.cosine" in fitted and leaf in {"sigma", "alpha", "g1"}:
                out[name] = _derived(tissue, known, part, attrgetter(leaf), UNITS[leaf])
            else:
                out[name] = _raw(tissue, name, known if name in fitted else None)
        for leaf, (unit, quantity) in DERIVED.items():
            out[f"{part}.{leaf}"] = _derived(tissue, known, part, quantity, unit)
    return out


def _weights(tissue: Optics, part: str) -> tuple[float, ...]:
    # Blend weights of a tooth, ``shape`` or ``3.shape``.
    return tissue.shape if isinstance(tissue, Tissue) else tissue.teeth[int(part.partition(".")[0])].shape


def _raw(tissue: Optics, name: str, known: Uncertainty | None) -> Estimate:
    unit = UNITS[kind_of(name)]
    if known is None:
        return Estimate(value=tissue.value(name), se=None, unit=unit, determined=False)
    slope = np.zeros(len(known.x))
    for k, coordinate in enumerate(known.domain.coordinates):
        if name in coordinate.targets:
            slope[k] = natural_derivative(coordinate.kind, float(known.x[k]))
    return _estimate(tissue.value(name), unit, known, slope)


def _estimate(value: float, unit: str, known: Uncertainty, slope: Array) -> Estimate:
    se, determined = known.standard_error(slope), known.is_determined(slope)
    return Estimate(value=value, se=se, unit=unit, determined=determined, se_parts=known.se_parts(slope))


def _derived(
    tissue: Optics, known: Uncertainty | None, part: str, quantity: Callable[[Medium], float], unit: str
) -> Estimate:
    value = quantity(tissue.medium(part))
    if known is None:
        return Estimate(value=value, se=None, unit=unit, determined=False)
    # Central differences in the unbounded domain; the step is far below every scale and far above rounding.
    slope, step = np.zeros(len(known.x)), 1e-5
    for k, coordinate in enumerate(known.domain.coordinates):
        if any(target.startswith(f"{part}.") for target in coordinate.targets):
            shift = np.zeros(len(known.x))
            shift[k] = step
            high, low = (
                quantity(known.domain.tissue_at(known.x + sign * shift, tissue).medium(part)) for sign in (1, -1)
            )
            slope[k] = (high - low) / (2 * step)
    if not slope.any():
        return Estimate(value=value, se=None, unit=unit, determined=False)
    return _estimate(value, unit, known, slope)


def instrument_estimates(known: Uncertainty) -> dict[str, Estimate]:
    """The instrument's errors by name; one is determined where the images tell it better than the calibration did."""
    first, found = known.domain.tissue_count, {}
    for k, (name, before) in enumerate(zip(known.domain.errors.names, known.domain.errors.se.tolist(), strict=True)):
        slope = np.zeros(len(known.x))
        slope[first + k] = 1.0
        se = known.standard_error(slope)
        found[name] = Estimate(
            value=float(known.x[first + k]),
            se=se,
            unit="1",
            determined=se < MIN_DATA_SHARE**0.5 * before,
            se_parts=known.se_parts(slope),
        )
    return found
