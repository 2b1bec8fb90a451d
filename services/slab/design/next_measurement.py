"""Search for the further measurement that would help most, by the bound of the fit's images together with those of
another cell, dilution or camera.

The material is taken to be what the fit found. Diluting it by a known factor divides f and sigma_a by that factor and
leaves the shape of ln f, so the information on ln f from two dilutions adds up, as that from two cells of different
width does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import SlabCamera, SlabFolder, SlabImage
from services.slab.cell.dictionary import KNOTS, Material
from services.slab.cell.forward import Blocks
from services.slab.cell.rig import rig_of
from services.slab.design.bound import curvature_of
from services.slab.read.diagnosis import THINNEST
from services.slab.read.images import Measurements
from services.slab.solve.measured_directions import measured_directions
from services.slab.solve.prior import THICK, precision
from services.slab.solve.uncertainty import phase_chain, slopes

Array = NDArray[np.float64]

FACTORS = (0.125, 0.25, 0.5, 2.0, 4.0)
"""Factors on the concentration, and on the cell's width."""
BESIDE_DEG = 4.0
"""Angle in air between a beam and a camera that is to look beside it: a beam of a degree or two is then out of its
sight."""
NEAR_DEG = 8.0
"""Largest angle between a beam and a camera at which the camera already looks beside it."""
PATHS = 1000
"""Paths per batch, light and candidate: a hundredth of what a fit spends in all."""
UNKNOWN_LN_F = 10.0
"""Standard deviation of ln f at a knot where images determine nothing."""
MIN_IMPROVEMENT = 0.2
"""Smallest part by which a measurement must cut the error to be named."""
SIMILAR = 0.1
"""Largest share by which the error after another measurement may be above the best one's for it to be named too: a
sample that cannot be diluted may be put into a thinner cell."""


@dataclass(frozen=True)
class Candidate:
    """A possible further measurement."""

    description: str
    folder: SlabFolder
    dilution: float = 1.0
    """Factor on f and sigma_a."""


def next_measurement(
    folder: SlabFolder,
    wavelength_nm: float,
    index: float,
    measured: Measurements,
    material: Material,
    scale: float | Array,
    seed: int,
    blocks: Blocks = map,
) -> str:
    """One sentence on what to measure next and how much it would help; empty where no candidate would cut the largest
    error much.

    Args:
        index: index of refraction of the sample.
        material: as the fit found it.
        scale: the smoothness prior's scale that the fit used.
    """
    variances = np.where(measured.held_out[:, None], np.inf, measured.variances)
    prior = precision(scale)
    # Where images determine nothing at all, ln f may be off by ten at each knot, and the absorption by all of the
    # extinction.
    prior[np.diag_indices(KNOTS)] += UNKNOWN_LN_F**-2
    prior[-1, -1] += material.extinction_per_mm**-2
    rig = rig_of(folder, wavelength_nm, index)
    noise = _noise_share(measured, 2 if rig.grid.folded else 1)
    present = measured_directions(
        curvature_of(rig, material, noise=0.0, variances=variances, seed=seed, paths=PATHS, blocks=blocks), prior
    ).curvature
    before = errors_of(material, _inverse(present + prior))
    worst = max(before, key=lambda name: before[name])
    after = {}
    for candidate in candidates(folder, wavelength_nm, material):
        other = Material(candidate.dilution * material.scattering, candidate.dilution * material.absorption_per_mm)
        other_rig = rig_of(candidate.folder, wavelength_nm, index)
        quadratic = curvature_of(other_rig, other, noise=noise, seed=seed, paths=PATHS, blocks=blocks)
        # Convert to ln f of the sample as it is, and to its own absorption.
        unit = np.append(np.ones(KNOTS), candidate.dilution)
        added = measured_directions(quadratic, prior).curvature * np.outer(unit, unit)
        after[candidate.description] = errors_of(material, _inverse(present + added + prior))[worst]
    if not after:
        return ""
    best = min(after, key=lambda name: after[name])
    if after[best] > (1 - MIN_IMPROVEMENT) * before[worst]:
        return ""
    advice = (
        f"What would help most: {best}. The error of {worst} that the images' noise and smoothness leave, without the"
        f" paths' noise that the standard errors hold too, would fall from {_percent(before[worst])} to"
        f" {_percent(after[best])}."
    )
    similar = [name for name, error in after.items() if name != best and error <= (1 + SIMILAR) * after[best]]
    return f"{advice} Nearly as much would come of this: {similar[0]}." if similar else advice


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "more than 100 %"


def candidates(folder: SlabFolder, wavelength_nm: float, material: Material) -> Iterator[Candidate]:
    """Dilutions and cells within the range in which a fit comes near its bound, and a camera beside a beam where none
    is.

    Beyond ``THICK`` fits stay ten times above the bound, so that its promise would not come true there.
    """
    thickness, width_mm = material.extinction_per_mm * folder.cell.width_mm, folder.cell.width_mm
    for factor in FACTORS:
        if THINNEST <= factor * thickness <= THICK:
            how = f"dilute it {1 / factor:g}-fold" if factor < 1 else f"concentrate it {factor:g}-fold"
            yield Candidate(f"{how} and measure again beside these images", folder, factor)
            cell = folder.cell.model_copy(update={"width_mm": factor * width_mm})
            other = folder.model_copy(update={"cell": cell})
            yield Candidate(f"measure it in a cell of {factor * width_mm:.3g} mm beside these images", other)
    if (beside := _beside_a_beam(folder, wavelength_nm)) is not None:
        yield beside


def errors_of(material: Material, covariance: Array) -> dict[str, float]:
    """Relative errors of sigma_s, sigma_s' and the phase function, from a covariance of ln f and sigma_a."""
    slope = slopes(material)
    values = {
        "sigma_s": material.scattering_per_mm,
        "sigma_s_reduced": material.scattering_per_mm * (1 - material.mean_cosine),
    }
    names = {"sigma_s": "σs", "sigma_s_reduced": "σs′"}
    found = {
        names[name]: float(np.sqrt(slope[name] @ covariance @ slope[name])) / value for name, value in values.items()
    }
    chain, phase = phase_chain(material), material.phase_per_sr
    variance = np.einsum("ij,jk,ik->i", chain, covariance, chain, optimize=True) * phase**2
    found["the phase function (rms over its angles)"] = float(np.sqrt(variance.sum() / (phase**2).sum()))
    return found


def _beside_a_beam(folder: SlabFolder, wavelength_nm: float) -> Candidate | None:
    """All images of one more camera beside the through-beam of the first light; None where a camera looks there
    already.
    """
    entries = folder.images_at(wavelength_nm)
    lights = {light.name: light for light in folder.lights}
    cameras = {camera.name: camera for camera in folder.cameras}
    for image in entries:
        light, camera = lights[image.light], cameras[image.camera]
        if camera.side != light.side and abs(camera.angle_deg - light.angle_deg) <= NEAR_DEG:
            return None
    first = lights[entries[0].light]
    side = "back" if first.side == "front" else "front"
    angle_deg = first.angle_deg + (BESIDE_DEG if first.angle_deg <= 0 else -BESIDE_DEG)
    name = "beside the beam"
    more = SlabCamera.model_construct(name=name, side=side, angle_deg=angle_deg, kind="orthographic")
    images = tuple(
        SlabImage.model_construct(
            camera=name, light=one, wavelength_nm=wavelength_nm, file="", variance_file=None, held_out=False
        )
        for one in dict.fromkeys(image.light for image in entries)
    )
    other = folder.model_copy(update={"cameras": (*folder.cameras, more), "images": images, "exposures": ()})
    description = (
        f"add a camera at the {side} at {angle_deg:g} degrees, {BESIDE_DEG:g} degrees beside the beam of light"
        f" {first.name}"
    )
    return Candidate(description, other)


def _noise_share(measured: Measurements, averaged: int) -> float:
    """Standard deviation of a pixel that has its image's mean, as a share of it, the median over all images; a value
    averages ``averaged`` pixels.
    """
    usable = np.isfinite(measured.variances) & ~measured.held_out[:, None]
    shares = [
        variances[use].sum() / max(float(values[use].mean() * values[use].sum()), 1e-300)
        for variances, values, use in zip(measured.variances, measured.values, usable, strict=True)
        if use.any()
    ]
    return float(np.sqrt(averaged * np.median(shares)))
