"""The notes of a fit: sentences on what was assumed, what the images do not tell, and what seems wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.rig import Rig
from services.slab.read.diagnosis import misfit_faults, sample_faults, similarity_faults, standing_out
from services.slab.read.images import Measurements
from services.slab.results.result import Errors, Parameters, PhaseFunction, image_error, is_unlike
from services.slab.solve.solution import Solution

Array = NDArray[np.float64]

LARGE_PATH_VARIANCE = 1.0
"""Variance by the paths, in units of that by the images, above which paths are the larger part of the standard
errors."""


def notes_of(
    rig: Rig,
    dictionary: str,
    measured: Measurements,
    solution: Solution,
    parameters: Parameters,
    phase: PhaseFunction,
    errors: Errors,
    renders: tuple[Array, Array],
) -> tuple[str, ...]:
    """All notes of one wavelength's fit but that on the next measurement.

    Args:
        dictionary: name of the dictionary.
        renders: two independent renders (images, pixels) of the fit's material.
    """
    notes = list(measured.faults)
    if not is_unlike(errors):  # else the material is not that of the cell
        notes += sample_faults(solution.material, rig.width_mm)
    notes += similarity_faults(
        solution.material,
        rig.width_mm,
        scattering=parameters.sigma_s.determined,
        reduced=parameters.sigma_s_reduced.determined,
    )
    misfit = misfit_faults(dictionary, solution.misfit, solution.misfit_se, solution.used, converged=solution.converged)
    notes += misfit
    if (misfit or is_unlike(errors)) and (odd := _odd_one_out(measured, renders)):
        notes.append(odd)
    if measured.assumed_noise:
        notes.append(
            "Images without a variance file are taken to have shot noise of 1 % at a pixel of the image's mean."
        )
    return tuple(notes + _on_phase(phase) + _on_solver(solution))


def is_short_of_paths(solution: Solution) -> bool:
    """Whether the noise of the paths is the larger part of the standard errors."""
    return solution.path_variance > LARGE_PATH_VARIANCE


def _on_phase(phase: PhaseFunction) -> list[str]:
    notes = []
    if bands := [_range(low, high) for low, high in phase.undetermined_bands_deg()]:
        ranges = " and ".join([", ".join(bands[:-1]), bands[-1]] if bands[1:] else bands)
        notes.append(
            f"The images do not determine the phase function {ranges} degrees; what is given there is the prior's."
        )
    widths_deg = [
        width for width, determined in zip(phase.resolution_deg, phase.determined, strict=False) if determined
    ]
    if widths_deg:
        finest, coarsest = min(widths_deg), max(widths_deg)
        notes.append(
            f"The images resolve structure of the phase function that is {finest:.0f} to {coarsest:.0f} degrees wide,"
            " depending on the angle. Narrower structure, such as rings of spheres, is averaged, and each standard"
            " error is that of the average."
        )
    return notes


def _range(low_deg: float, high_deg: float) -> str:
    return f"from {low_deg:.1f} to {high_deg:.1f}" if high_deg > low_deg else f"at {low_deg:.1f}"


def _on_solver(solution: Solution) -> list[str]:
    notes = []
    if is_short_of_paths(solution):
        notes.append(
            f"The fit spent its steps while the noise of its paths was {solution.path_variance:.2g} times that of the"
            " images in variance; raise option effort for a smaller standard error."
        )
    if not solution.converged:
        notes.append(
            "The fit has not converged: its search spent its steps, or its last step still promised far more than noise"
            " does."
        )
    return notes


def _odd_one_out(measured: Measurements, renders: tuple[Array, Array]) -> str:
    images = zip(*renders, measured.values, measured.variances, strict=True)
    return standing_out(measured.places, [image_error(*image).value for image in images])
