"""Translucency of a slab, as dental laboratories state it: the same slab over a black and over a white backing.

The translucency parameter TP is the CIELAB difference of both (Johnston et al. 1995), the contrast ratio the quotient
of their luminances Y over black and white. Both are computed under daylight D65 for the observer of CIE 1931.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.colour.cie import lab_from_xyz
from services.core.colour.observer import FIRST_NM, LAST_NM, MAX_GAP_NM, daylight_weights
from services.core.geometry import Record
from services.core.slab.folder import Cell
from services.slab.sphere.invert import MIN_STEP, Fitted, interface_of
from services.slab.sphere.records import SphereFile
from services.slab.sphere.search import DIFFERENCE
from services.transport.optics.slab_totals import Optics, Totals, slab_totals

Array = NDArray[np.float64]


class Lab(Record):
    """A colour in CIELAB under D65."""

    L: float
    a: float
    b: float


class Translucency(Record):
    """A slab over two backings that touch it with air between."""

    translucency_parameter: float
    translucency_parameter_se: float
    contrast_ratio: float
    contrast_ratio_se: float
    over_black: Lab
    over_white: Lab
    black: float
    """Reflectance of the black backing, diffuse and the same at all wavelengths, as that of the white one."""
    white: float


@dataclass(frozen=True)
class _Spectrum:
    nm: Array
    reflectance: Array
    """Reflectance over black and over white (2, wavelengths)."""
    covariance: Array
    """Covariance of both at each wavelength (wavelengths, 2, 2)."""


def over_backing(totals: Totals, backing: float) -> float:
    """Reflectance of a slab for a beam along the normal, over a diffuse backing: light goes to and fro between them."""
    returned = totals.transmittance * backing * totals.transmittance_diffuse
    return totals.reflectance + returned / (1 - backing * totals.reflectance_diffuse)


def translucency_of(file: SphereFile, fits: list[Fitted], black: float, white: float) -> Translucency | None:
    """Translucency from the fitted media of all wavelengths; None where they do not cover the visible range."""
    spectrum = _spectrum(file, fits, (black, white))
    if spectrum is None:
        return None
    value = _appearance(spectrum.nm, spectrum.reflectance)
    # Wavelengths are independent: the variance is the sum over them of slope^T covariance slope.
    variance = np.zeros(2)
    for k, covariance in enumerate(spectrum.covariance):
        slopes = np.zeros((2, 2))
        for face in (0, 1):
            moved = spectrum.reflectance.copy()
            moved[face, k] += DIFFERENCE
            slopes[:, face] = (_appearance(spectrum.nm, moved)[:2] - value[:2]) / DIFFERENCE
        variance += np.einsum("ij,jk,ik->i", slopes, covariance, slopes)
    se = np.sqrt(variance)
    colours = [Lab(L=float(x[0]), a=float(x[1]), b=float(x[2])) for x in (value[2:5], value[5:8])]
    return Translucency(
        translucency_parameter=float(value[0]), translucency_parameter_se=float(se[0]),
        contrast_ratio=float(value[1]), contrast_ratio_se=float(se[1]),
        over_black=colours[0], over_white=colours[1], black=black, white=white,
    )  # fmt: skip


def _spectrum(file: SphereFile, fits: list[Fitted], backings: tuple[float, float]) -> _Spectrum | None:
    known = [
        (reading.wavelength_nm, reading.cell or file.cell, fitted)
        for reading, fitted in zip(file.totals, fits, strict=True)
        if reading.wavelength_nm
    ]
    known.sort(key=lambda one: one[0])
    nm = np.array([wavelength for wavelength, _, _ in known])
    if len(nm) < 2 or nm[0] > FIRST_NM or nm[-1] < LAST_NM or not np.diff(nm).all():
        return None  # a wavelength that comes twice is of another sample
    within = nm[(nm >= 400) & (nm <= 700)]
    if len(within) < 2 or np.diff(within).max() > MAX_GAP_NM:
        return None

    def reflectances(cell: Cell, optics: Optics) -> Array:
        totals = slab_totals(optics, cell.width_mm, interface_of(cell))
        return np.array([over_backing(totals, backing) for backing in backings])

    values, covariances = [], []
    for _, cell, fitted in known:
        optics = fitted.optics
        value = reflectances(cell, optics)
        slopes = np.zeros((2, 2))
        sizes = np.array([optics.absorption_per_mm, optics.scattering_per_mm * (1 - optics.g)])
        steps = DIFFERENCE * np.maximum(sizes, MIN_STEP / cell.width_mm)
        for column, (absorbing, scattering) in enumerate(np.diag(steps)):
            moved = Optics(
                optics.absorption_per_mm + absorbing, optics.scattering_per_mm + scattering / (1 - optics.g), optics.g
            )
            slopes[:, column] = (reflectances(cell, moved) - value) / steps[column]
        values.append(value)
        covariances.append(slopes @ fitted.covariance @ slopes.T)
    return _Spectrum(nm, np.array(values).T, np.array(covariances))


def _appearance(nm: Array, reflectance: Array) -> Array:
    """TP, contrast ratio, and CIELAB over black and over white (8,) from reflectances (2, wavelengths)."""
    nodes_nm, weights = daylight_weights()
    spectra = np.array([np.interp(nodes_nm, nm, row) for row in reflectance])
    xyz = spectra @ weights
    lab = lab_from_xyz(xyz, weights.sum(axis=0))
    return np.concatenate([[np.linalg.norm(lab[0] - lab[1]), xyz[0, 1] / xyz[1, 1]], lab[0], lab[1]])
