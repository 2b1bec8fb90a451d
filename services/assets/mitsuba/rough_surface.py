"""The rough dielectric surface of stock Mitsuba, with mean factors for the light that meets several of its facets."""

from __future__ import annotations

from typing import Any

import numpy as np

from services.transport.boundary.rough import Rough
from services.transport.optics.ggx_albedo import ANGLES, albedo_tables


def rough_surface(ior: float, roughness: float, *, compensated: bool) -> dict[str, Any]:
    """Stock Mitsuba's rough dielectric, which follows light to one facet and loses the rest.

    A fit divides by the albedo at each angle. The scene has its means instead, over light that arrives evenly from one
    side: the inside's where light is reflected, and the geometric mean of both sides' where it passes. Light out of a
    ball is then 1.4 and 2.9 % brighter than in the fit (GGX roughness 0.15 and 0.3, index 1.631), in place of 30 %
    darker at 0.3; highlights are 5 and 16 % too bright.

    Args:
        compensated: whether the fit gave this light back.
    """
    surface = Rough.mitsuba(ior, roughness=roughness)
    if not compensated:
        return surface
    outside, inside = mean_albedos(roughness, ior)
    return surface | {
        "specular_reflectance": 1 / inside,
        "specular_transmittance": 1 / float(np.sqrt(outside * inside)),
    }


def mean_albedos(roughness: float, ior: float) -> tuple[float, float]:
    """Share of the light that one facet gives back or lets through, for even light from outside and from inside."""
    # The tables' cosines are squares u^2 of equal steps, and even light weighs them by the cosine: u^2 d(u^2).
    u = np.linspace(0, 1, ANGLES)
    weight = u**3
    outside, inside = (float((table * weight).sum() / weight.sum()) for table in albedo_tables(roughness, ior)[0])
    return outside, inside
