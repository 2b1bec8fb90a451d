"""The sample's index of refraction from the point where a slanted beam leaves the cell (Gkioulekas et al. 2013, section
5).

A beam at angle a outside is bent to a', n sin a' = n0 sin a, and leaves the other face at a distance x from its entry:

    x = w tan a' + 2 g        with g the displacement along x in one glass, none without walls

so one measured x gives tan a' and with it n. Several beams are averaged by the inverse squares of their errors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from services.core.errors import CaptureInputError
from services.core.slab.folder import Cell, SlabFolder, ThroughBeam

SMALLEST_INDEX, LARGEST_INDEX = 1.0, 4.0
MAX_DIFFERENCE_SE = 4.0
"""Largest difference of one beam's index from the mean of all, in standard errors: more is no noise of the peaks."""


class Index(NamedTuple):
    """An index of refraction."""

    value: float
    se: float
    """Standard error; 0 where the index was given."""


def index_of(folder: SlabFolder, wavelength_nm: float) -> Index:
    """The sample's index at a wavelength: as the folder gives it, or from the shifts of its through-beams.

    Raises:
        CaptureInputError: the shifts belong to no index, or contradict each other.
    """
    if folder.cell.index is not None or folder.cell.boundary == "matched":
        return Index(folder.cell.index or folder.cell.index_outside, 0.0)
    angles = {light.name: light.angle_deg for light in folder.lights}
    beams = [beam for beam in folder.through_beam if beam.wavelength_nm in (None, wavelength_nm)]
    found = {beam.light: _index(folder.cell, angles[beam.light], beam) for beam in beams}
    weights = {light: one.se**-2 for light, one in found.items()}
    total = sum(weights.values())
    mean = sum(weights[light] * one.value for light, one in found.items()) / total
    for light, one in found.items():
        if abs(one.value - mean) > MAX_DIFFERENCE_SE * one.se:
            raise CaptureInputError(
                f"The through-beam of light {light} at {wavelength_nm:g} nm gives an index of {one.value:.3f} ±"
                f" {one.se:.1g} and all together {mean:.3f}; measure its peak_x_mm again, or correct the light's"
                " angle_deg or the cell's width_mm."
            )
    return Index(mean, total**-0.5)


def _index(cell: Cell, angle_deg: float, beam: ThroughBeam) -> Index:
    outside = cell.index_outside * math.sin(math.radians(angle_deg))
    glass_mm = 0.0
    if cell.glass is not None:
        sine = outside / cell.glass.index
        glass_mm = 2 * cell.glass.thickness_mm * sine / math.sqrt(1 - sine * sine)
    tangent = (beam.peak_x_mm - glass_mm) / cell.width_mm
    if tangent * outside <= 0:
        raise CaptureInputError(_impossible(beam, "the beam would be bent to the other side"))
    sine = tangent / math.hypot(1.0, tangent)
    value = outside / sine
    if not SMALLEST_INDEX <= value <= LARGEST_INDEX:
        raise CaptureInputError(_impossible(beam, f"the sample's index would be {value:.3g}"))
    # dn/dx = -n / tan a' / (1 + tan^2 a') / w
    return Index(value, abs(value / tangent / (1 + tangent**2)) / cell.width_mm * beam.se_mm)


def _impossible(beam: ThroughBeam, why: str) -> str:
    what = f"The through-beam of light {beam.light} peaks at x = {beam.peak_x_mm:g} mm, with which {why}"
    return f"{what}; correct its peak_x_mm, the light's angle_deg or the cell's width_mm."
