"""The GGX distribution of a rough surface's facets, Smith's shadowing, and their derivatives to the roughness.

A direction is given by its cosine to the mean normal, positive on its own side. Equations are those of Walter et al.
2007; facets are sampled among the visible ones (Heitz 2018).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def distribution(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """Density of facets by area, 1/sr, whose normal is at ``cosine`` to the mean normal (Eq. 33)."""
    squared = dr.square(roughness)
    return squared * dr.inv_pi / dr.square(_spread(cosine, squared))


def visible_share(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """Smith's G1: the share of facets that a direction sees (Eq. 34)."""
    return cosine * visible_share_over_cosine(cosine, roughness)


def visible_share_over_cosine(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """G1 over the cosine, which stays finite at grazing directions."""
    return 2 / (cosine + _stretched(cosine, roughness))


def score_of_distribution(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """D ln D / d ln roughness."""
    squared = dr.square(roughness)
    return 2 - 4 * squared * dr.square(cosine) / _spread(cosine, squared)


def score_of_visible_share(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """D ln G1 / d ln roughness."""
    length = _stretched(cosine, roughness)
    return -(dr.square(length) - dr.square(cosine)) / (length * (cosine + length))


def visible_normal(towards: mi.Vector3f, roughness: mi.Float, u: mi.Float, v: mi.Float) -> mi.Vector3f:
    """A facet's normal, in proportion to the area that a local direction ``towards``, z > 0, sees of such facets."""
    # Stretch the surface so that the facets become a hemisphere.
    stretched = dr.normalize(mi.Vector3f(roughness * towards.x, roughness * towards.y, towards.z))
    squared = dr.square(stretched.x) + dr.square(stretched.y)
    across = mi.Vector3f(-stretched.y, stretched.x, 0) * dr.rsqrt(dr.maximum(squared, 1e-30))
    across = dr.select(squared > 1e-30, across, mi.Vector3f(1, 0, 0))
    along = dr.cross(stretched, across)

    # Sample the projection of its visible half.
    radius, (sine, cosine) = dr.sqrt(u), dr.sincos(2 * dr.pi * v)
    x = radius * cosine
    y = dr.lerp(dr.sqrt(dr.maximum(1 - dr.square(x), 0)), radius * sine, 0.5 * (1 + stretched.z))
    z = dr.sqrt(dr.maximum(1 - dr.square(x) - dr.square(y), 0))
    normal = across * x + along * y + stretched * z

    # Squeeze it back.
    return dr.normalize(mi.Vector3f(roughness * normal.x, roughness * normal.y, dr.maximum(normal.z, 1e-6)))


def _spread(cosine: mi.Float, squared: mi.Float) -> mi.Float:
    """(a c)^2 + s^2, without the difference of two numbers near 1."""
    cosine2 = dr.square(cosine)
    return dr.fma(squared, cosine2, dr.maximum(1 - cosine2, 0))


def _stretched(cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    cosine2 = dr.square(cosine)
    return dr.sqrt(cosine2 + dr.square(roughness) * dr.maximum(1 - cosine2, 0))
