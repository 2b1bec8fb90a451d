"""A plausible texture of stains, for phantoms: darker towards the gums, streaks along the tooth, and a few spots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh
from services.transport.scene.stain_uv import StainLayout, ToothStains, stain_layout

TEXEL_MM = 0.5
"""Size of a texel on the surface, mm."""
STRENGTH = {"red": 0.6, "green": 1.0, "blue": 1.4}
"""Relative strength of stains by channel: they are brown, so they absorb more of blue."""

NECK_DEPTH = 0.25
"""Optical depth at the neck's end of the surface; it decays by 1/e over a quarter of the surface's length."""
STREAK_DEPTH, STREAK_MM = 0.12, 1.6
"""Largest optical depth of vertical streaks, and their shortest period, mm."""
SPOTS, SPOT_DEPTH, SPOT_MM = 6, 0.5, 0.9
"""Number of spots, optical depth at their middle, and radius at which it falls to 1/e, mm."""


def painted_stains(outer: Mesh, channels: tuple[str, ...], seed: int) -> ToothStains:
    """Stain textures for each channel, which differ only in strength."""
    layout = stain_layout(outer, TEXEL_MM)
    return ToothStains(
        layout.corners_uv,
        {name: layout.texture(painted_depth(layout, seed, STRENGTH.get(name, 1.0))) for name in channels},
    )


def painted_depth(layout: StainLayout, seed: int, strength: float = 1.0) -> NDArray[np.float64]:
    """Optical depths (T,) of the texels; the tooth lies in the canonical frame (x mesial, y buccal, z occlusal).

    Args:
        layout: places of the texels on the surface.
        seed: seed of streaks and spots.
        strength: factor on every depth; it is smaller for a channel that stains absorb less.
    """
    random = np.random.default_rng(seed)
    place = layout.points_mm
    low, high = place[:, 2].min(), place[:, 2].max()
    height = (place[:, 2] - low) / max(high - low, 1e-9)
    depth = NECK_DEPTH * np.exp(-4 * height)

    # Make streaks a function of x alone, so that they run along the tooth.
    phases = random.uniform(0, 2 * np.pi, 3)
    waves = sum(
        np.cos(2 * np.pi * place[:, 0] / (STREAK_MM * factor) + phase)
        for factor, phase in zip((1.0, 1.7, 2.9), phases, strict=True)
    )
    depth = depth + STREAK_DEPTH * np.clip(waves / 3, 0, None)

    # Put spots on the side that faces the cameras.
    front = np.flatnonzero(place[:, 1] > np.median(place[:, 1]))
    for texel in random.choice(front, size=min(SPOTS, len(front)), replace=False):
        depth = depth + SPOT_DEPTH * np.exp(-(((place - place[texel]) / SPOT_MM) ** 2).sum(axis=1))
    return np.asarray(strength * depth)
