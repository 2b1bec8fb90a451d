"""Unpolarised Fresnel reflectance of a dielectric."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def reflectance(cosine: mi.Float, eta: mi.Float) -> mi.Float:
    """Reflectance for light arriving at ``cosine`` >= 0, eta = n_beyond / n_before; 1 under total internal reflection.

    With q = eta cos(theta_t), q^2 = (eta^2 - 1) + cosine^2, both amplitudes carry the factor eta^2 - 1: no difference
    of nearly equal numbers is taken, however close eta is to 1.
    """
    contrast = (eta - 1) * (eta + 1)
    cosine2 = dr.square(cosine)
    q2 = contrast + cosine2
    q = dr.sqrt(dr.maximum(q2, 0))
    s = contrast / dr.square(cosine + q)
    p = contrast * dr.fma(dr.square(eta) + 1, cosine2, -1) / dr.square(dr.fma(dr.square(eta), cosine, q))
    return dr.select(q2 > 0, 0.5 * (dr.square(s) + dr.square(p)), 1)
