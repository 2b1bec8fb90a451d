"""Light that a rough surface reflects once, in NumPy: the lobe of GGX facets (Walter et al. 2007)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.ggx_albedo import fresnel_reflectance

Array = NDArray[np.float64]


def reflected(normal: Array, to_light: Array, to_camera: Array, roughness: float, ior: float) -> Array:
    """Reflected radiance over the irradiance of a surface at right angles to the beam, 1/sr: D F G / (4 |n·v|), (...).

    Args:
        normal, to_light, to_camera: (..., 3), unit directions that point away from the surface.
        roughness: GGX roughness. ior: refractive index of the inside over that of the outside.
    """
    half = to_light + to_camera
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    n_l, n_v, n_h = (_dot(normal, direction) for direction in (to_light, to_camera, half))
    squared = roughness**2
    facets = squared / (np.pi * (n_h**2 * (squared - 1) + 1) ** 2)
    # Smith's G1 of the camera's side is divided by its cosine, which cancels, so that grazing views stay finite
    lit, seen = (
        2 / (cosine + np.sqrt(squared + (1 - squared) * cosine**2))
        for cosine in (np.maximum(n_l, 0), np.maximum(n_v, 0))
    )
    radiance = facets * fresnel_reflectance(np.clip(_dot(half, to_light), 0, 1), ior) * lit * n_l * seen / 4
    return np.where((n_l > 0) & (n_v > 0), radiance, 0.0)


def _dot(one: Array, other: Array) -> Array:
    return np.asarray((one * other).sum(axis=-1))
