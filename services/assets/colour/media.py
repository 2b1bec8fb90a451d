"""Media in the colour spaces of renderers, and as spectra.

A fit finds a medium's coefficients in the camera's channels, whose colours are not those of a renderer. Images in
another space are linear in images of the channels, and coefficients are not. So each medium keeps in the other space
the colour of its half space under diffuse light, which the matrix transforms exactly, and the logarithm of its reduced
extinction, which is transformed as the images are to first order. Between channels that differ little, as those of
teeth, images agree to second order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.assets.colour.spaces import ACESCG, LINEAR_SRGB, ColourSpace
from services.core.colour.observer import daylight_weights
from services.transport.optics.half_space import albedo_of_reflectance, half_space_reflectance
from services.transport.optics.parameters import Medium

Floats = NDArray[np.float64]
MIN_REFLECTANCE, MAX_REFLECTANCE = 1e-3, 0.999
"""Range of a half space's reflectance: colours outside of a space's gamut are clipped to it."""
PRIMARIES_NM = (464.2, 549.1, 611.4)
"""Dominant wavelengths of the blue, green and red primaries of sRGB under D65, nm."""
MAX_NEWTON_STEPS = 60
SMALL = 1e-10
"""Largest error of the colour of an upsampled spectrum, in linear sRGB."""


@dataclass(frozen=True)
class ReducedMedium:
    """A medium by what images determine, one value for each channel or wavelength."""

    sigma_s_reduced: Floats
    """Reduced scattering, 1/mm."""
    sigma_a: Floats
    """Absorption, 1/mm."""
    reflectance: Floats
    """Reflectance of a half space under diffuse light, 0 to 1."""

    @classmethod
    def of(cls, media: list[Medium]) -> ReducedMedium:
        """The medium of some channels."""
        return cls(
            np.array([one.sigma_s_reduced for one in media]),
            np.array([(1 - one.alpha) * one.sigma for one in media]),
            np.array([half_space_reflectance(one) for one in media]),
        )

    @classmethod
    def of_reflectance(cls, reflectance: Floats, extinction: Floats) -> ReducedMedium:
        """The medium that has a half space's reflectance and a reduced extinction, 1/mm."""
        clipped = np.clip(reflectance, MIN_REFLECTANCE, MAX_REFLECTANCE)
        albedo = albedo_of_reflectance(clipped)
        return cls(albedo * extinction, (1 - albedo) * extinction, clipped)

    @property
    def extinction(self) -> Floats:
        """Reduced extinction, 1/mm."""
        return np.asarray(self.sigma_s_reduced + self.sigma_a)

    def transformed(self, matrix: Floats) -> ReducedMedium:
        """The medium in the space to which a matrix (3, 3) with rows that add up to 1 takes colours."""
        return ReducedMedium.of_reflectance(
            matrix @ self.reflectance, np.exp(matrix @ np.log(np.maximum(self.extinction, 1e-12)))
        )


def matrix_between(xyz_from_camera: Floats, space: ColourSpace) -> Floats:
    """Matrix (3, 3) from a camera's channels to a space, by XYZ under D50; its rows add up to 1, so white stays."""
    matrix = space.rgb_from_xyz() @ xyz_from_camera
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


def acescg_from_srgb() -> Floats:
    """Matrix (3, 3) from linear sRGB to ACEScg."""
    return np.asarray(ACESCG.rgb_from_xyz() @ np.linalg.inv(LINEAR_SRGB.rgb_from_xyz()))


def upsampled(medium: ReducedMedium) -> tuple[Floats, ReducedMedium]:
    """Wavelengths (31,), nm, and the spectrum of a medium in linear sRGB.

    The half space's reflectance is the smooth spectrum of Jakob & Hanika 2019 (eq. 6) that has the medium's colour
    under D65. The reduced extinction is interpolated between the primaries' dominant wavelengths and constant beyond.
    Both are assumptions: three channels do not tell a spectrum.
    """
    nm, _ = daylight_weights()
    reflectance = smooth_spectrum(medium.reflectance)
    extinction = np.exp(np.interp(nm, PRIMARIES_NM, np.log(medium.extinction[::-1])))
    return nm, ReducedMedium.of_reflectance(reflectance, extinction)


def srgb_of_spectrum(reflectance: Floats) -> Floats:
    """Linear sRGB (..., 3) under D65 of reflectances (..., 31) from 400 to 700 nm."""
    _, weights = daylight_weights()
    return np.asarray(reflectance @ weights @ LINEAR_SRGB.rgb_from_xyz(weights.sum(axis=0)).T)


def smooth_spectrum(rgb: Floats) -> Floats:
    """Reflectance (31,) from 400 to 700 nm of linear sRGB (3,): 1/2 + x / (2 sqrt(1 + x^2)) of a quadratic x, whose
    three coefficients Newton's method finds with halved steps.
    """
    target = np.clip(rgb, MIN_REFLECTANCE, MAX_REFLECTANCE)
    nm, _ = daylight_weights()
    t = (nm - nm.mean()) / (nm[-1] - nm[0])
    powers = np.stack([np.ones_like(t), t, t**2], axis=1)
    middle = 2 * target.mean() - 1
    c = np.array([middle / np.sqrt(1 - middle**2), 0.0, 0.0])

    def spectrum(coefficients: Floats) -> Floats:
        x = powers @ coefficients
        return np.asarray(0.5 + x / (2 * np.sqrt(1 + x**2)))

    error = srgb_of_spectrum(spectrum(c)) - target
    for _ in range(MAX_NEWTON_STEPS):
        if np.abs(error).max() < SMALL:
            break
        slope = 0.5 * (1 + (powers @ c) ** 2) ** -1.5
        jacobian = srgb_of_spectrum((slope[:, None] * powers).T).T
        step = np.linalg.lstsq(jacobian, error, rcond=None)[0]
        size = 1.0
        while size > 1e-6:
            tried = srgb_of_spectrum(spectrum(c - size * step)) - target
            if np.abs(tried).sum() < np.abs(error).sum():
                break
            size /= 2
        c, error = c - size * step, tried
    return spectrum(c)
