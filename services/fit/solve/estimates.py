"""Reported estimates of the parameters and of quantities derived from them: value, standard error, and whether the data
determine it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import TWIST
from services.core.results import Estimate
from services.fit.coordinates.domain import UNITS, kind_of, natural_derivative
from services.fit.solve.covariance import MIN_DATA_SHARE, Uncertainty
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Optics, Tissue

Array = NDArray[np.float64]
DERIVED: Mapping[str, tuple[str, Callable[[Medium], float]]] = MappingProxyType(
    {
        "sigma_s_reduced": ("1/mm", lambda m: m.sigma_s_reduced),
        "sigma_a": ("1/mm", lambda m: (1 - m.alpha) * m.sigma),
        "alpha_reduced": ("1", lambda m: m.alpha_reduced),
        "mean_cosine": ("1", lambda m: m.mean_cosine),
    }
)
"""Derived quantities of a medium that are reported beside its parameters: unit and formula."""
UNITS_OF_MOVES: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(TWIST[:3], "rad") | dict.fromkeys(TWIST[3:], "mm") | dict.fromkeys("xy", "px")
)
"""Units of the coordinates of the scan's pose and of a photograph's shift, by the end of their name; all other errors
of the instrument are relative."""
DIFFERENCE_STEP = 1e-5
"""Step of central differences in the unbounded domain, far below every scale and far above rounding."""


def estimates(
    tissue: Optics, parts: Iterable[str], uncertainty: Uncertainty | None, shape_uncertainty: Uncertainty | None = None
) -> dict[str, Estimate]:
    """Estimates of every parameter of the named parts, and of the derived quantities, by name: unit, standard error and
    whether the data determine it.

    Args:
        tissue: tissue parameters of the solution.
        parts: names ``enamel``, ``dentin``, ``shape``, for a mouth ``3.enamel``, ``3.shape``, ``gums`` or ``cavity``.
        uncertainty: uncertainty of the fitted coordinates; None where nothing was fitted.
        shape_uncertainty: uncertainty of the blend weights where the fit of another channel determined them.
    """
    fitted = set(uncertainty.domain.parameters) if uncertainty is not None else set()
    out: dict[str, Estimate] = {}
    for part in parts:
        if part == "cavity":
            out["cavity.reflectance"] = _raw(
                tissue, "cavity.reflectance", uncertainty if "cavity.reflectance" in fitted else None
            )
            continue
        if part.rpartition(".")[2] == "shape":
            names = [f"{part}.{k}" for k in range(len(_weights(tissue, part)))]
            out |= {name: _raw(tissue, name, uncertainty if name in fitted else shape_uncertainty) for name in names}
            continue
        around = {} if uncertainty is None else _media_around(tissue, uncertainty, part)
        for leaf in MEDIUM_FIELDS:
            name = f"{part}.{leaf}"
            if f"{part}.cosine" in fitted and leaf in {"sigma", "alpha", "g1"}:
                out[name] = _derived(tissue.medium(part), around, uncertainty, attrgetter(leaf), UNITS[leaf])
            else:
                out[name] = _raw(tissue, name, uncertainty if name in fitted else None)
        for leaf, (unit, quantity) in DERIVED.items():
            out[f"{part}.{leaf}"] = _derived(tissue.medium(part), around, uncertainty, quantity, unit)
    return out


def _weights(tissue: Optics, part: str) -> tuple[float, ...]:
    # Blend weights of the tooth that a part such as ``shape`` or ``3.shape`` names.
    return tissue.shape if isinstance(tissue, Tissue) else tissue.teeth[int(part.partition(".")[0])].shape


def _raw(tissue: Optics, name: str, uncertainty: Uncertainty | None) -> Estimate:
    unit = UNITS[kind_of(name)]
    if uncertainty is None:
        return Estimate(value=tissue.value(name), se=None, unit=unit, determined=False)
    slope = np.zeros(len(uncertainty.x))
    for k, coordinate in enumerate(uncertainty.domain.coordinates):
        if name in coordinate.targets:
            slope[k] = natural_derivative(coordinate.kind, float(uncertainty.x[k]))
    return _estimate(tissue.value(name), unit, uncertainty, slope)


def _estimate(value: float, unit: str, uncertainty: Uncertainty, slope: Array) -> Estimate:
    se, determined = uncertainty.standard_error(slope), uncertainty.is_determined(slope)
    return Estimate(value=value, se=se, unit=unit, determined=determined, se_parts=uncertainty.se_parts(slope))


def _media_around(tissue: Optics, uncertainty: Uncertainty, part: str) -> dict[int, tuple[Medium, Medium]]:
    # The part's medium one step above and one step below x, by the coordinates that change it.
    around = {}
    for k, coordinate in enumerate(uncertainty.domain.coordinates):
        if any(target.startswith(f"{part}.") for target in coordinate.targets):
            shift = np.zeros(len(uncertainty.x))
            shift[k] = DIFFERENCE_STEP
            high, low = (
                uncertainty.domain.tissue_at(uncertainty.x + sign * shift, tissue).medium(part) for sign in (1, -1)
            )
            around[k] = high, low
    return around


def _derived(
    medium: Medium,
    around: Mapping[int, tuple[Medium, Medium]],
    uncertainty: Uncertainty | None,
    quantity: Callable[[Medium], float],
    unit: str,
) -> Estimate:
    value = quantity(medium)
    if uncertainty is None:
        return Estimate(value=value, se=None, unit=unit, determined=False)
    slope = np.zeros(len(uncertainty.x))
    for k, (high, low) in around.items():
        slope[k] = (quantity(high) - quantity(low)) / (2 * DIFFERENCE_STEP)
    if not slope.any():
        return Estimate(value=value, se=None, unit=unit, determined=False)
    return _estimate(value, unit, uncertainty, slope)


def instrument_estimates(uncertainty: Uncertainty) -> dict[str, Estimate]:
    """Estimates of the instrument's errors by name; an error is determined where the images add more information than
    the calibration gave.
    """
    first, found = uncertainty.domain.tissue_count, {}
    for k, (name, prior_se) in enumerate(
        zip(uncertainty.domain.errors.names, uncertainty.domain.errors.se.tolist(), strict=True)
    ):
        slope = np.zeros(len(uncertainty.x))
        slope[first + k] = 1.0
        se = uncertainty.standard_error(slope)
        found[name] = Estimate(
            value=float(uncertainty.x[first + k]),
            se=se,
            unit=UNITS_OF_MOVES.get(name.rpartition(".")[2], "1"),
            determined=se < MIN_DATA_SHARE**0.5 * prior_se,
            se_parts=uncertainty.se_parts(slope),
        )
    return found
