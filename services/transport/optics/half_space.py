"""Diffuse reflectance of a deep medium."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.parameters import Medium

QUADRATIC, LINEAR, SATURATION = 0.139, 1.139, 1.17
"""Coefficients of van de Hulst's fit, as the polynomial (1 - LINEAR s + QUADRATIC s^2) / (1 + SATURATION s)."""


def half_space_reflectance(medium: Medium) -> float:
    """Reflectance of a half space under diffuse light, its surface index-matched; within 0.0021 of the exact value for
    isotropic scattering.

    Similarity theory gives a medium of any phase function the reflectance of the isotropic one of albedo alpha' (teeth
    2018, section 4.3); for that one A = (1 - s)(1 - 0.139 s) / (1 + 1.17 s), s = sqrt(1 - alpha'), is van de Hulst's
    fit (Multiple Light Scattering, 1980, section 11.3).
    """
    s = math.sqrt(1 - medium.alpha_reduced)
    return (1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s)


def albedo_of_reflectance(reflectance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reduced albedo of a half space that has a reflectance of 0 to 1: the smaller root of the same fit."""
    half = LINEAR + SATURATION * reflectance
    s = (half - np.sqrt(half**2 - 4 * QUADRATIC * (1 - reflectance))) / (2 * QUADRATIC)
    return np.asarray(1 - np.clip(s, 0.0, 1.0) ** 2)
