"""Diffuse reflectance of a deep medium."""

from __future__ import annotations

import math

from services.transport.optics.parameters import Medium


def half_space_reflectance(medium: Medium) -> float:
    """Reflectance of a half space under diffuse light, its surface index-matched; within 0.0021 of the exact value for
    isotropic scattering.

    Similarity theory gives a medium of any phase function the reflectance of the isotropic one of albedo alpha' (teeth
    2018, section 4.3); for that one A = (1 - s)(1 - 0.139 s) / (1 + 1.17 s), s = sqrt(1 - alpha'), is van de Hulst's
    fit (Multiple Light Scattering, 1980, section 11.3).
    """
    s = math.sqrt(1 - medium.alpha_reduced)
    return (1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s)
