"""How much light a rough dielectric surface gives back or through in all, by the angle of arrival.

A lossless surface gives back or lets through all light, but facets that are followed for one scattering only lose the
light that meets a second facet: 1 to 18 % of it. Divided by these albedos, both lobes of one side lose nothing
(Turquin 2019). The result is not reciprocal: the side and angle from which a *walk* arrives are normalised.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ANGLES = 128
"""Number of cosines of a table, the squares of equal steps from 0 to 1, because the albedo bends most where light
grazes; between them it is interpolated linearly."""
RADII, AZIMUTHS = 96, 64
"""Number of Gauss nodes over the visible facets."""
MIN_COSINE = 1e-5
"""Cosine that stands for 0, where the albedo has its limit."""


@cache
def albedo_tables(roughness: float, ior: float) -> tuple[Array, Array]:
    """Albedos (2, ANGLES) of light that arrives from the thin and from the dense side, by its cosine, and the
    derivatives d ln albedo / d ln roughness.
    """
    thin, dense = _albedo(roughness, ior), _albedo(roughness, 1 / ior)
    return np.stack([thin[0], dense[0]]), np.stack([thin[1], dense[1]])


def fresnel_reflectance(cosine: Array, eta: float) -> Array:
    """Fresnel's reflectance for light arriving at ``cosine``; ``eta`` is the index beyond over the index before."""
    q2 = eta**2 - 1 + cosine**2
    q = np.sqrt(np.maximum(q2, 0))
    s, p = (cosine - q) / (cosine + q), (eta**2 * cosine - q) / (eta**2 * cosine + q)
    return np.where(q2 > 0, 0.5 * (s**2 + p**2), 1.0)


def _albedo(roughness: float, eta: float) -> tuple[Array, Array]:
    """Mean of Smith's G1 of the outgoing direction over the visible facets, reflected and refracted; and its
    logarithmic derivative, which is the mean of the scores of all three factors that depend on the roughness.
    """
    cosine = np.maximum(np.linspace(0, 1, ANGLES) ** 2, MIN_COSINE)[:, None, None]
    sine = np.sqrt(1 - cosine**2)
    nodes, weights = np.polynomial.legendre.leggauss(RADII)
    turns, turn_weights = np.polynomial.legendre.leggauss(AZIMUTHS)
    # The two halves of the azimuth about the plane of arrival are mirror images.
    u, azimuth = 0.5 * (nodes[:, None] + 1), 0.5 * np.pi * turns[None, :]
    weight = 0.25 * weights[:, None] * turn_weights[None, :]

    # Sample visible facets as the kernel does; the direction of arrival lies in the plane x = 0.
    length = np.sqrt((roughness * sine) ** 2 + cosine**2)
    stretched_y, stretched_z = roughness * sine / length, cosine / length
    x = np.sqrt(u) * np.cos(azimuth)
    share = 0.5 * (1 + stretched_z)
    y = (1 - share) * np.sqrt(1 - x**2) + share * np.sqrt(u) * np.sin(azimuth)
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normal_y = z * stretched_y - y * stretched_z
    normal_z = np.maximum(z * stretched_z + y * stretched_y, 1e-6)
    scale = np.sqrt((roughness * x) ** 2 + (roughness * normal_y) ** 2 + normal_z**2)
    facet_x, facet_y, facet_z = roughness * x / scale, roughness * normal_y / scale, normal_z / scale

    arriving = np.clip(facet_y * sine + facet_z * cosine, 0, 1)
    mirrored = fresnel_reflectance(arriving, eta)
    refracted = np.sqrt(np.maximum(1 - (1 - arriving**2) / eta**2, 0))
    back = 2 * arriving * facet_z - cosine
    through = -(facet_z * (arriving / eta - refracted) - cosine / eta)
    of_distribution = 2 - 4 * (roughness * facet_z) ** 2 / ((roughness * facet_z) ** 2 + facet_x**2 + facet_y**2)
    score = of_distribution + _score_of_visible_share(cosine, roughness)
    total, slope = np.zeros(ANGLES), np.zeros(ANGLES)
    for share, away in ((mirrored, back), (1 - mirrored, through)):
        lobe = weight * share * _visible_share(away, roughness)
        total += lobe.sum(axis=(1, 2))
        slope += (lobe * (score + _score_of_visible_share(np.clip(away, 0, 1), roughness))).sum(axis=(1, 2))
    return total, slope / total


def _visible_share(cosine: Array, roughness: float) -> Array:
    clipped = np.clip(cosine, 0, 1)
    return np.where(cosine > 0, 2 * clipped / (clipped + np.sqrt(clipped**2 + roughness**2 * (1 - clipped**2))), 0)


def _score_of_visible_share(cosine: Array, roughness: float) -> Array:
    """D ln G1 / d ln roughness."""
    stretched2 = roughness**2 * (1 - cosine**2)
    length = np.sqrt(cosine**2 + stretched2)
    return np.asarray(-stretched2 / (length * (cosine + length)))
