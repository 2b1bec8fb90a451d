"""Checks whether a cell's images determine its phase function, and advice on what to measure instead.

Images are checked one by one before the fit. Thickness and absorption of the sample come from the fit itself, because
the HG medium that it starts from confuses a thin sample with an absorbing one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.core.slab.dictionaries import DEFAULT_DICTIONARY
from services.core.slab.folder import Beam, Light, PixelGrid, SlabCamera
from services.slab.cell.dictionary import Material

Array = NDArray[np.float64]

THINNEST, THICKEST = 0.1, 10.0
"""Range of sigma_t w in which images determine a phase function (Gkioulekas et al. 2013, figure 6): below, they hold
little but noise, above, light has forgotten each single deflection."""
BEST = 2.0
"""Value of sigma_t w to aim at: many photons scatter, and most of those that do only a few times."""
CELLS_MM = 0.01, 100.0
"""Narrowest and widest cell that is proposed: those that are sold."""
MIN_ALBEDO = 0.2
"""Smallest albedo. Below it most of the light that scatters is absorbed before it leaves, and higher orders add
nothing."""
MAX_AT_MAXIMUM = 4
"""Largest number of pixels that may share an image's largest value: so many are alike by symmetry in an image without
noise."""
MAX_MISFIT_SIGMAS = 5.0
"""Largest excess of the squared residuals over the noise, in standard errors, before a dictionary is doubted: the
chance is 3e-7 a fit."""
MAX_SQUARES = 2.0
"""Mean of the squared residuals over their variances above which a fit by tents is doubted: variances that are stated
only roughly give values near 1."""
BESIDE_BEAM_DEG = 5.0
"""Smallest angle in air, degrees, between a camera and the beam behind the cell, or its mirror image before it, at
which the camera's light has been scattered for certain."""
POWER_OF_A_CONE = 2.5
"""Power that an image may show, in units of the beam's power spread evenly over the cone around the beam in which the
camera lies. No phase function that falls with the angle sends more there, and the rest is a margin."""
MIN_MAX_POWER_PER_SR = 1.0
"""Smallest share of the beam's power per sr at which an image is refused; a white diffuser sends 1 / pi."""
STANDING_OUT = 1.5
"""Ratio of the least error of a camera's or a light's images to the largest of all others, from which it is named."""
MIN_LIT = 0.5
"""Smallest share of an image's maximum at which a pixel counts for the position of the beam."""
MAX_BEAM_OFFSET = 1.0
"""Largest distance of the beam from y = 0, in pixels and in sizes of the beam, whichever is more."""


def power_per_sr(image: Array, pixels: PixelGrid, camera: SlabCamera) -> float:
    """Share of the beam's power that an image (rows, columns) shows leaving towards its camera, per sr."""
    (x_low, x_high), (y_low, y_high) = pixels.x_mm, pixels.y_mm
    area_mm2 = (x_high - x_low) * (y_high - y_low) / image.size
    return float(np.nansum(image)) * area_mm2 * math.cos(math.radians(camera.angle_deg))


def max_power_per_sr(camera: SlabCamera, light: Light) -> float:
    """Largest share of the beam's power that any material sends towards a camera, per sr; infinite where the camera may
    see the beam itself or its mirror image in the cell's face.
    """
    angle_deg = abs(camera.angle_deg - light.angle_deg)
    if angle_deg < BESIDE_BEAM_DEG:
        return math.inf
    cone_sr = 2 * math.pi * (1 - math.cos(math.radians(angle_deg)))
    return max(POWER_OF_A_CONE / cone_sr, MIN_MAX_POWER_PER_SR)


def image_faults(name: str, image: Array, pixels: PixelGrid, beam: Beam) -> tuple[str, ...]:
    """Faults of one image (rows, columns) as taken, a sentence each.

    Args:
        name: camera and light, such as "b0 under l1".
    """
    finite = np.where(np.isfinite(image), image, -np.inf)
    largest = float(finite.max())
    if largest <= 0:
        return (f"Image {name} holds no light; check its exposure and its file.",)
    if (count := int((finite == largest).sum())) > MAX_AT_MAXIMUM:
        what = f"Image {name} looks saturated: {count} pixels hold its largest value, {largest:.4g}"
        return (f"{what}; expose it for less long, or give those pixels no value (NaN).",)
    return _off_axis(name, finite, largest, pixels, beam)


def _off_axis(name: str, image: Array, largest: float, pixels: PixelGrid, beam: Beam) -> tuple[str, ...]:
    # Beams and cameras lie in the plane y = 0, so every image is symmetric about it.
    low, high = pixels.y_mm
    pitch_mm = (high - low) / pixels.rows
    y_mm = low + pitch_mm * (np.arange(pixels.rows) + 0.5)
    lit = np.where(image >= MIN_LIT * largest, image, 0.0)
    centre_mm = float(lit.sum(axis=1) @ y_mm / lit.sum())
    if abs(centre_mm) <= MAX_BEAM_OFFSET * max(pitch_mm, beam.size_mm):
        return ()
    return (
        (
            f"In image {name} the light lies {abs(centre_mm):.2g} mm off the plane y = 0; centre the beam or correct"
            " pixels.y_mm."
        ),
    )


def grid_faults(pixels: PixelGrid) -> tuple[str, ...]:
    """A sentence for each axis along which the beam's entry point x = y = 0 lies beside the pixels."""
    beside = [axis for axis, (low, high) in (("x", pixels.x_mm), ("y", pixels.y_mm)) if not low < 0 < high]
    return tuple(
        f"The beam meets the cell at {axis} = 0, beside the pixels; correct pixels.{axis}_mm." for axis in beside
    )


def sample_faults(material: Material, width_mm: float) -> tuple[str, ...]:
    """Sentences on a sample that is too thin, too thick or too absorbing to determine its phase function, and on what
    to measure instead.
    """
    thickness = material.extinction_per_mm * width_mm
    albedo = material.scattering_per_mm / material.extinction_per_mm
    known = f"σt·w is about {thickness:.2g}, and images tell a phase function from {THINNEST:g} to {THICKEST:g}"
    faults = []
    if thickness < THINNEST:
        what = f"concentrate it {BEST / thickness:.2g}-fold{_or_a_cell_of(width_mm * BEST / thickness)}"
        faults.append(f"The sample is too thin: {known}; {what}.")
    if thickness > THICKEST:
        what = f"dilute it {thickness / BEST:.2g}-fold{_or_a_cell_of(width_mm * BEST / thickness)}"
        faults.append(f"The sample is too thick: {known}; {what}.")
    if albedo < MIN_ALBEDO:
        faults.append(
            f"The sample absorbs too much: about {100 * (1 - albedo):.0f} % of what meets a particle is absorbed, and"
            " little but single scattering leaves the cell; measure at a wavelength that is absorbed less, or take a"
            " thinner cell."
        )
    return tuple(faults)


def _or_a_cell_of(width_mm: float) -> str:
    low_mm, high_mm = CELLS_MM
    return f", or take a cell of {width_mm:.2g} mm" if low_mm <= width_mm <= high_mm else ""


def similarity_faults(material: Material, width_mm: float, *, scattering: bool, reduced: bool) -> tuple[str, ...]:
    """A sentence where the images fix sigma_s' alone, as in thick samples, with what would tell sigma_s and g apart.

    Args:
        scattering: whether the images determine sigma_s.
        reduced: whether the images determine sigma_s'.
    """
    thickness = material.extinction_per_mm * width_mm
    if scattering or not reduced or thickness <= BEST:
        return ()
    remedy = f"dilute it {thickness / BEST:.2g}-fold, or take a cell of {width_mm * BEST / thickness:.2g} mm"
    what = (
        f"The images fix σs′, but not σs and g by themselves: at a σt·w of {thickness:.2g} light has forgotten its"
        " single deflections"
    )
    return (
        f"{what}. Take σs, g and the phase function with their standard errors alone; to tell them apart, {remedy}.",
    )


def standing_out(places: Sequence[tuple[str, str]], errors: Sequence[float]) -> str:
    """A sentence on the one camera or light all of whose images are much further from the fit than all others; empty if
    there is none.

    Args:
        places: camera and light of each image.
        errors: relative error of each image.
    """
    for position, what in enumerate(("camera", "light")):
        for name in dict.fromkeys(place[position] for place in places):
            own = [error for place, error in zip(places, errors, strict=True) if place[position] == name]
            others = [error for place, error in zip(places, errors, strict=True) if place[position] != name]
            if len(others) > 1 and min(own) > STANDING_OUT * max(others):
                nearest, farthest = (f"{100 * error:.0f}" for error in (min(own), max(own)))
                extent = f"{nearest} %" if nearest == farthest else f"{nearest} to {farthest} %"
                return (
                    f"The images of {what} {name} are {extent} off the fit, and all others at most"
                    f" {100 * max(others):.0f} %; check its angle, its side and its files first."
                )
    return ""


def misfit_faults(dictionary: str, misfit: float, misfit_se: float, values: int, *, converged: bool) -> tuple[str, ...]:
    """A sentence where the images differ from the fit by more than their noise.

    A dictionary of few atoms may lack the material. The tents can make any, so with them the images' variances, the
    description of the cell, or a search that has not converged is at fault.

    Args:
        misfit: half the weighted squares at the solution.
        misfit_se: Monte Carlo error of the misfit.
        values: number of the weighted squares.
        converged: whether the solver has converged.
    """
    squares, error = 2 * misfit / values, math.hypot(math.sqrt(2 / values), 2 * misfit_se / values)
    is_default = dictionary == DEFAULT_DICTIONARY
    if squares <= (MAX_SQUARES if is_default else 1) + MAX_MISFIT_SIGMAS * error:
        return ()
    ratio = math.sqrt(squares)
    times = f"by {ratio:.0f} times their noise" if ratio >= 10 else f"by {ratio:.2g} times their noise"
    if is_default:
        remedy = "check" if converged else "let the fit converge first, and then check"
        sentence = (
            f"The images differ from the fit {times}, so its standard errors say too little: {remedy} their variances,"
            " and the cell, the beam and the angles that the folder describes."
        )
    else:
        sentence = (
            f"The images differ from the nearest mix of dictionary {dictionary} {times}: the material may be no such"
            f" mix, and then ± say too little; compare with {DEFAULT_DICTIONARY}."
        )
    return (sentence,)
