"""Records of a slab's result, as ``parameters.json``, ``phase.json`` and ``errors.json`` hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.core.geometry import Record
from services.core.results import Figure, FitReport, Verdict
from services.core.slab.dictionaries import DEFAULT_DICTIONARY
from services.core.verdict import MAX_ERROR, verdict_of
from services.slab.cell.dictionary import ANGLES_RAD, Material
from services.slab.dictionaries.through_beam import Index
from services.slab.solve.uncertainty import (
    LARGEST_COEFFICIENT_SHARE,
    Uncertainty,
    phase_errors,
    resolution_deg,
    slopes,
)

SlabUnit = Literal["1/mm", "1", "um"]


class Quantity(Record):
    """A measured number."""

    value: float
    se: float = Field(description="standard error")
    unit: SlabUnit
    determined: bool = Field(description="whether the images fix it, and not the prior")


class Parameters(Record):
    """Coefficients of one wavelength."""

    sigma_t: Quantity
    sigma_s: Quantity
    sigma_a: Quantity
    sigma_s_reduced: Quantity
    g: Quantity
    index: Quantity


class PhaseFunction(Record):
    """Phase function at the dictionary's knots, normalised so that 2 pi times the integral of p sin(theta) is 1."""

    theta_deg: tuple[float, ...]
    value_per_sr: tuple[float, ...]
    se_per_sr: tuple[float, ...]
    determined: tuple[bool, ...]
    resolution_deg: tuple[float, ...] = Field(
        default=(),
        description=(
            "width of the narrowest structure that the images resolve at each angle; standard errors are those of the"
            " phase function averaged over it; empty of a dictionary with few atoms"
        ),
    )

    def undetermined_bands_deg(self) -> tuple[tuple[float, float], ...]:
        """Ranges of angle, degrees, whose values come from the prior."""
        bands: list[tuple[float, float]] = []
        open_at: float | None = None
        for theta, determined in zip(self.theta_deg, self.determined, strict=True):
            if not determined:
                open_at, last = (theta if open_at is None else open_at), theta
            elif open_at is not None:
                bands.append((open_at, last))
                open_at = None
        return (*bands, (open_at, last)) if open_at is not None else tuple(bands)


class Errors(Record):
    """Relative errors of predicted against measured images, without the noise of either."""

    fit_error: float
    held_out_error: float | None
    fit_error_se: float | None = Field(default=None, description="standard error by the noise of images and renders")
    held_out_error_se: float | None = None


class SlabFit(Record):
    """Result of one wavelength."""

    wavelength_nm: float
    parameters: Parameters
    phase: PhaseFunction
    errors: Errors
    notes: tuple[str, ...] = Field(description="sentences about what was assumed and what the images do not tell")
    converged: bool
    steps: int = Field(description="of the solver, in its search and its last stages")
    paths: int
    core_seconds: float
    dictionary: str = Field(default=DEFAULT_DICTIONARY, description="what the phase function was built from")
    atoms: dict[str, Quantity] = Field(default={}, description="of the dictionary, where it has few; see ``atoms_of``")


MAX_TOLD_THICKNESS = 7.0
"""Optical thickness sigma_t w above which sigma_s, what contains it and the phase function are not called determined,
whatever their standard errors. Fits at 5.4 were right within 1.2 standard errors, of those at 9.1 one was off by 4."""
TOLD_IN_THICK_CELLS = ("sigma_a", "sigma_s_reduced")


def parameters_of(material: Material, uncertainty: Uncertainty, index: Index, width_mm: float) -> Parameters:
    """The coefficients with their standard errors.

    The absorption, which may be small, is judged relative to the extinction that it is part of.
    """
    is_told = material.extinction_per_mm * width_mm <= MAX_TOLD_THICKNESS
    values = {
        "sigma_t": material.extinction_per_mm,
        "sigma_s": material.scattering_per_mm,
        "sigma_a": material.absorption_per_mm,
        "sigma_s_reduced": material.scattering_per_mm * (1 - material.mean_cosine),
        "g": material.mean_cosine,
    }
    quantities = {}
    for name, slope in slopes(material).items():
        reference = {"g": 1.0, "sigma_a": material.extinction_per_mm}.get(name, abs(values[name]))
        quantities[name] = Quantity(
            value=values[name],
            se=uncertainty.standard_error(slope),
            unit="1" if name == "g" else "1/mm",
            determined=uncertainty.larger_error(slope) <= LARGEST_COEFFICIENT_SHARE * reference
            and (is_told or name in TOLD_IN_THICK_CELLS),
        )
    return Parameters(**quantities, index=Quantity(value=index.value, se=index.se, unit="1", determined=True))


def phase_of(material: Material, uncertainty: Uncertainty, width_mm: float) -> PhaseFunction:
    """The phase function with its standard errors."""
    errors, determined = phase_errors(material, uncertainty)
    determined &= material.extinction_per_mm * width_mm <= MAX_TOLD_THICKNESS
    return PhaseFunction(
        theta_deg=tuple(np.degrees(ANGLES_RAD).tolist()),
        value_per_sr=tuple(material.phase_per_sr.tolist()),
        se_per_sr=tuple(errors.tolist()),
        determined=tuple(determined.tolist()),
        resolution_deg=() if uncertainty.averaging is None else tuple(resolution_deg(uncertainty.averaging).tolist()),
    )


def image_error(
    first: NDArray[np.float64], second: NDArray[np.float64], values: NDArray[np.float64], variances: NDArray[np.float64]
) -> Figure:
    """Relative error from two independent renders, with the measurements' noise subtracted from both sums.

    Its standard error is that of its square, by the scatter of the pixels' terms, carried through the root: the
    distance from the error to the root of its square and one standard error more.
    """
    usable = np.isfinite(variances)
    y, noise = values[usable], variances[usable]
    terms = (first[usable] - y) * (second[usable] - y) - noise
    norm = max(float(y @ y - noise.sum()), 1e-300)
    square, square_se = max(float(terms.sum()), 0.0) / norm, float(np.sqrt(terms.size) * terms.std()) / norm
    value = float(np.sqrt(square))
    return Figure(value=value, se=float(np.sqrt(square + square_se)) - value)


def is_unlike(errors: Errors) -> bool:
    """Whether the images are so far from those of the fit that none of its numbers is believed."""
    return max(errors.fit_error, errors.held_out_error or 0.0) > MAX_ERROR


def with_believable_flags(fit: SlabFit) -> SlabFit:
    """The fit, with nothing called determined where it is unlike its images."""
    if not is_unlike(fit.errors):
        return fit
    unknown = {"determined": False}
    parameters = {name: one.model_copy(update=unknown) for name, one in fit.parameters}
    return fit.model_copy(
        update={
            "parameters": fit.parameters.model_copy(update=parameters),
            "phase": fit.phase.model_copy(update={"determined": (False,) * len(fit.phase.determined)}),
            "atoms": {name: one.model_copy(update=unknown) for name, one in fit.atoms.items()},
        }
    )


COMPARE_SET_UP = (
    "compare slab.json with the set-up: widths and sizes in mm, angles in degrees with their signs, sides, which file"
    " is which, and the unit of images or, of exposures, beam.power and exposure_s."
)
"""Advice where the description of the cell may be wrong."""


class SlabReport(Record):
    """Published by the fit stage of a slab: all its wavelengths."""

    fits: tuple[SlabFit, ...]

    def verdict(self) -> Verdict:
        """The verdict on all wavelengths together, where each wavelength takes the place of a channel."""
        errors = {f"{fit.wavelength_nm:g}": fit.errors for fit in self.fits}
        stopped = [fit for fit in self.fits if not fit.converged]
        unlike = [fit for fit in self.fits if is_unlike(fit.errors)]
        advice = ""
        if any(fit.converged for fit in unlike):
            advice = f"No material gives such images at {_wavelengths(unlike)}; {COMPARE_SET_UP}"
        elif unlike:
            advice = (
                f"The fit at {_wavelengths(unlike)} ended far from its images without converging. Fit again with a"
                f" greater option effort and another seed. If it ends the same, {COMPARE_SET_UP}"
            )
        elif stopped:
            advice = f"The fit at {_wavelengths(stopped)} has not converged; raise option effort."
        summary = FitReport(
            converged=not stopped,
            advice=advice,
            parameters={},
            fit_error={name: one.fit_error for name, one in errors.items()},
            held_out_error=_known({name: one.held_out_error for name, one in errors.items()}),
            fit_error_se=_known({name: one.fit_error_se for name, one in errors.items()}),
            held_out_error_se=_known({name: one.held_out_error_se for name, one in errors.items()}),
            steps=sum(fit.steps for fit in self.fits),
            seconds=sum(fit.core_seconds for fit in self.fits),
        )
        return verdict_of(summary)


def _known(errors: Mapping[str, float | None]) -> dict[str, float]:
    return {name: error for name, error in errors.items() if error is not None}


def _wavelengths(fits: Sequence[SlabFit]) -> str:
    return ", ".join(f"{fit.wavelength_nm:g} nm" for fit in fits)


@dataclass(frozen=True)
class Wavelength:
    """One wavelength's result, with its images (images, rows, columns)."""

    fit: SlabFit
    measured: NDArray[np.float64]
    """NaN where a pixel was left out."""
    predicted: NDArray[np.float64]
    held_out: NDArray[np.bool_]
    names: tuple[str, ...]
    """Camera and light of each image."""
    averaging: NDArray[np.float64] | None = None
    """Averaging kernels of the phase function; see ``Uncertainty``."""
