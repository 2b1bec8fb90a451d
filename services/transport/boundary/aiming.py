"""Directions inside from which a rough face with a given normal passes light on to a light outside: their density, and
samples of it. Facets are drawn among those that the light sees, and a direction is bent at its facet by Snell's law.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from services.transport.optics import ggx

LOWEST = 0.05
"""Cosine to the normal to which lights below it are lifted."""


def lifted(direction: mi.Vector3f, normal: mi.Vector3f) -> mi.Vector3f:
    """A light's direction, turned towards the normal where the surface would hide or hardly show the light."""
    missing = dr.maximum(LOWEST - dr.dot(direction, normal), 0)
    return dr.normalize(dr.fma(normal, missing, direction))


def bent(direction: mi.Vector3f, facet: mi.Vector3f, ior: mi.Float) -> mi.Vector3f:
    """Unit direction inside that a smooth facet bends into ``direction`` outside."""
    cosine = dr.dot(direction, facet)
    inside = dr.sqrt(dr.maximum(1 - (1 - dr.square(cosine)) / dr.square(ior), 0))
    return dr.normalize((direction + facet * (ior * inside - cosine)) / ior)


def sample(
    direction: mi.Vector3f, normal: mi.Vector3f, ior: mi.Float, roughness: mi.Float, u: mi.Float, v: mi.Float
) -> mi.Vector3f:
    """A direction inside that leads to the light in ``direction``, which is lifted."""
    frame = mi.Frame3f(normal)
    facet = ggx.visible_normal(frame.to_local(direction), roughness, u, v)
    return bent(direction, frame.to_world(facet), ior)


def density(
    omega: mi.Vector3f, direction: mi.Vector3f, normal: mi.Vector3f, ior: mi.Float, roughness: mi.Float
) -> mi.Float:
    """Density of ``sample`` at ``omega``, 1/sr (Walter et al. 2007, Eq. 17; Heitz 2018, Eq. 3)."""
    raw = direction / ior - omega
    facet = raw * dr.rsqrt(dr.maximum(dr.squared_norm(raw), 1e-20))
    facet = dr.mulsign(facet, dr.dot(facet, normal))
    outside, inside = dr.dot(direction, facet), dr.dot(omega, facet)
    facets = ggx.distribution(dr.dot(facet, normal), roughness) * ggx.visible_share_over_cosine(
        dr.maximum(dr.dot(direction, normal), 0), roughness
    )
    spread = inside * dr.square(ior) / dr.maximum(dr.square(ior * inside - outside), 1e-20)
    return dr.select((outside > 0) & (inside > 0), facets * outside * spread, 0)
