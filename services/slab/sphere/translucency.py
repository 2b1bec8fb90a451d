"""Translucency of a slab, as dental laboratories state it: the same slab over a black and over a white backing.

The translucency parameter TP is the CIELAB difference of both (Johnston et al. 1995), the contrast ratio the quotient
of their luminances Y over black and white. Both are computed under daylight D65 for the observer of CIE 1931.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Record
from services.core.slab.folder import Cell
from services.slab.sphere.invert import MIN_STEP, Fitted, interface_of
from services.slab.sphere.records import SphereFile
from services.slab.sphere.search import DIFFERENCE
from services.slab.sphere.totals import Optics, Totals, slab_totals

Array = NDArray[np.float64]

MAX_GAP_NM = 25.0
"""Largest step of a spectrum that gives a colour. A spectrum must also begin at 420 nm or before and end at 680 nm or
after."""
FIRST_NM, LAST_NM = 420.0, 680.0


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


def lab_of(xyz: Array, white: Array) -> Array:
    """CIELAB (..., 3) of tristimulus values (..., 3); ``white`` holds those of the illuminant."""
    ratio = xyz / white
    edge = 6 / 29
    f = np.where(ratio > edge**3, np.cbrt(ratio), ratio / (3 * edge**2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


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
    observer = _observer()
    weights = observer[:, 1:4] * observer[:, 4:5]
    weights /= weights[:, 1].sum()
    spectra = np.array([np.interp(observer[:, 0], nm, row) for row in reflectance])
    xyz = spectra @ weights
    lab = lab_of(xyz, weights.sum(axis=0))
    return np.concatenate([[np.linalg.norm(lab[0] - lab[1]), xyz[0, 1] / xyz[1, 1]], lab[0], lab[1]])


def _observer() -> Array:
    """Wavelength in nm, colour matching functions of CIE 1931 and power of D65 (31, 5): CIE 015, every 10 nm."""
    table = (
        (0.01431, 0.000396, 0.06785, 82.7549), (0.04351, 0.00121, 0.2074, 91.486),
        (0.13438, 0.004, 0.6456, 93.4318), (0.2839, 0.0116, 1.3856, 86.6823),
        (0.34828, 0.023, 1.74706, 104.865), (0.3362, 0.038, 1.77211, 117.008),
        (0.2908, 0.06, 1.6692, 117.812), (0.19536, 0.09098, 1.28764, 114.861),
        (0.09564, 0.13902, 0.81295, 115.923), (0.03201, 0.20802, 0.46518, 108.811),
        (0.0049, 0.323, 0.272, 109.354), (0.0093, 0.503, 0.1582, 107.802),
        (0.06327, 0.71, 0.07825, 104.79), (0.1655, 0.862, 0.04216, 107.689),
        (0.2904, 0.954, 0.0203, 104.405), (0.43345, 0.99495, 0.00875, 104.046),
        (0.5945, 0.995, 0.0039, 100), (0.7621, 0.952, 0.0021, 96.3342),
        (0.9163, 0.87, 0.00165, 95.788), (1.0263, 0.757, 0.0011, 88.6856),
        (1.0622, 0.631, 0.0008, 90.0062), (1.0026, 0.503, 0.00034, 89.5991),
        (0.85445, 0.381, 0.00019, 87.6987), (0.6424, 0.265, 5e-05, 83.2886),
        (0.4479, 0.175, 2e-05, 83.6992), (0.2835, 0.107, 1.90582e-21, 80.0268),
        (0.1649, 0.061, 0, 80.2146), (0.0874, 0.032, 0, 82.2778),
        (0.04677, 0.017, 0, 78.2842), (0.0227, 0.00821, 0, 69.7213),
        (0.0113592, 0.004102, 0, 71.6091),
    )  # fmt: skip
    return np.column_stack([np.arange(400.0, 701.0, 10.0), np.array(table)])
