"""CIE colours: L*a*b* and the colour difference ΔE2000."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
D50 = np.array([0.96422, 1.0, 0.82521])
"""XYZ of the white of illuminant D50, 2° observer (ICC.1:2022, section 7.2.16): the white of a camera's colours."""
D65 = np.array([0.95047, 1.0, 1.08883])
"""XYZ of the white of illuminant D65, 2° observer."""
OPPOSITE = 1e-9
"""Hues that differ by half a turn to this angle, rad, are opposite: rounding must not choose the side of their mean."""


def lab_from_xyz(xyz: Floats, white: Floats = D50) -> Floats:
    """Return the CIE 1976 L*, a*, b* (..., 3) of XYZ (..., 3), in which the white has Y = 1."""
    t = np.asarray(xyz) / white
    epsilon, kappa = (6 / 29) ** 3, (29 / 6) ** 2 / 3
    f = np.where(t > epsilon, np.cbrt(np.maximum(t, epsilon)), kappa * t + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def delta_e_2000(one: Floats, two: Floats) -> Floats:
    """Return the colour difference ΔE2000 (N,) of L*a*b* colours (N, 3) (Sharma, Wu & Dalal, Color Research and
    Application 30, 2005, eqs. 2 to 22).
    """
    (l1, a1, b1), (l2, a2, b2) = np.asarray(one).T, np.asarray(two).T
    mean_chroma = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * np.sqrt(mean_chroma**7 / (mean_chroma**7 + 25.0**7))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = np.arctan2(b1, stretch * a1) % (2 * np.pi), np.arctan2(b2, stretch * a2) % (2 * np.pi)
    is_grey = c1 * c2 == 0
    # Hues are angles: their difference is the shorter way round, and their mean lies on that way.
    # Of opposite hues, to rounding, the published mean is half their sum.
    turn = h2 - h1
    is_far = np.abs(turn) > np.pi + OPPOSITE
    difference = np.where(is_grey, 0.0, turn - 2 * np.pi * np.sign(turn) * is_far)
    mean_hue = np.where(is_grey, h1 + h2, h1 + difference / 2)
    d_lightness, d_chroma = l2 - l1, c2 - c1
    d_hue = 2 * np.sqrt(c1 * c2) * np.sin(difference / 2)
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    weight = (
        1
        - 0.17 * np.cos(mean_hue - np.deg2rad(30))
        + 0.24 * np.cos(2 * mean_hue)
        + 0.32 * np.cos(3 * mean_hue + np.deg2rad(6))
        - 0.20 * np.cos(4 * mean_hue - np.deg2rad(63))
    )
    rotated = np.deg2rad(60) * np.exp(-(((np.rad2deg(mean_hue) % 360 - 275) / 25) ** 2))
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(rotated)
    of_lightness = d_lightness / (1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2))
    of_chroma, of_hue = d_chroma / (1 + 0.045 * chroma), d_hue / (1 + 0.015 * chroma * weight)
    return np.asarray(np.sqrt(of_lightness**2 + of_chroma**2 + of_hue**2 + rotation * of_chroma * of_hue))
