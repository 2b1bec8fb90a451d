"""Henyey-Greenstein phase functions for propagation directions, in forms that hold in float32 (optics.md).

Every function uses the *deviation* m = 1 - sign(g) cos(theta), which keeps its relative precision where the lobe is
narrow: D = 1 + g^2 - 2 g cos(theta) becomes (1 - |g|)^2 + 2 |g| m, a sum of positive terms.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

INVERSE_FOUR_PI = 0.07957747154594767


def deviation(g: mi.Float, omega: mi.Vector3f, omega_out: mi.Vector3f) -> mi.Float:
    """1 - sign(g) omega . omega_out, from the squared chord so that nearly parallel directions stay apart."""
    return 0.5 * dr.squared_norm(omega_out - dr.mulsign(omega, g))


def density(g: mi.Float, m: mi.Float) -> mi.Float:
    """Phase function value, 1/sr."""
    a = dr.abs(g)
    d = dr.fma(2 * a, m, dr.square(1 - a))
    return INVERSE_FOUR_PI * (1 - a) * (1 + a) * dr.rcp(d * dr.sqrt(d))


def score_g(g: mi.Float, m: mi.Float) -> mi.Float:
    """Derivative d ln(density) / dg (teeth 2018 Eq. 13 in propagation directions)."""
    a = dr.abs(g)
    d = dr.fma(2 * a, m, dr.square(1 - a))
    return dr.mulsign(-2 * a / ((1 - a) * (1 + a)) + 3 * ((1 - a) - m) / d, g)


def sample_deviation(g: mi.Float, u: mi.Float) -> mi.Float:
    """Deviation of a sampled direction from u in [0, 1). Cancellation-free for every g, isotropic included."""
    a = dr.abs(g)
    r = dr.fma(2 * a, u, 1 - a)
    return (1 - a) * (1 - u) * ((1 - a) * (1 + a) / r + (1 - a)) / r


def deflected(omega: mi.Vector3f, g: mi.Float, m: mi.Float, u: mi.Float) -> mi.Vector3f:
    """Direction of deviation m about omega, azimuth 2 pi u."""
    sine, cosine = dr.sincos(2 * dr.pi * u)
    radius = dr.sqrt(dr.maximum(m * (2 - m), 0))
    s, t = mi.coordinate_system(omega)
    return dr.normalize(dr.mulsign(omega * (1 - m), g) + radius * (s * cosine + t * sine))
