"""Unpolarised Fresnel reflectance of a dielectric."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def reflectance(cosine: mi.Float, eta: mi.Float) -> mi.Float:
    """Reflectance for light arriving at ``cosine`` >= 0, eta = n_beyond / n_before; 1 under total internal reflection."""
    sine2 = (1 - dr.square(cosine)) / dr.square(eta)
    cosine_t = dr.sqrt(dr.maximum(1 - sine2, 0))
    s = (cosine - eta * cosine_t) / (cosine + eta * cosine_t)
    p = (eta * cosine - cosine_t) / (eta * cosine + cosine_t)
    return dr.select(sine2 >= 1, 1, 0.5 * (dr.square(s) + dr.square(p)))
