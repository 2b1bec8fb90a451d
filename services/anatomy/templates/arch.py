"""The dental arch: a superellipse on which teeth stand, parametrised by its arc length from the midline.

Jaw frame: x to the patient's left, y forward, z occlusal (an upper jaw's teeth point along +z, down), mm; the occlusal
plane is z = 0, the midline x = 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HALF_WIDTH_MM = 25.5
"""Half axis of the superellipse along x, mm."""
DEPTH_MM = 47.0
"""Half axis of the superellipse along y, mm. With the half width it places second molars 49 mm apart at their middles,
and gives the arc length that an average upper jaw's teeth need."""
EXPONENT = 2.2
"""Exponent of the superellipse; above 2 its front is flatter than that of an ellipse."""
STRAIGHT_MM = 20.0
"""Length by which the arch continues straight back behind its widest place, mm."""
FORWARD_MM = 22.0
"""Coordinate y of the arch at the midline, mm; the jaw's middle is the origin."""
STEPS = 8000
"""Number of points of a half arch."""


class Arch:
    """Curve through the middles of the teeth; the arc length is positive on the patient's left."""

    def __init__(self) -> None:
        angle = np.linspace(0, np.pi / 2, STEPS)
        radius = ((np.sin(angle) / HALF_WIDTH_MM) ** EXPONENT + (np.cos(angle) / DEPTH_MM) ** EXPONENT) ** (
            -1 / EXPONENT
        )
        x = np.append(radius * np.sin(angle), HALF_WIDTH_MM)
        y = np.append(radius * np.cos(angle), -STRAIGHT_MM) - DEPTH_MM + FORWARD_MM
        self._x, self._y = x, y
        self._length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        heading = np.arctan2(np.diff(y), np.diff(x))
        self._middle = (self._length[1:] + self._length[:-1]) / 2
        self._heading = heading

    def points_mm(self, length_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 2), x and y in mm, at signed arc lengths (N,)."""
        away = np.abs(length_mm)
        return np.stack(
            [np.sign(length_mm) * np.interp(away, self._length, self._x), np.interp(away, self._length, self._y)],
            axis=-1,
        )

    def tangents(self, length_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit tangents (N, 2) in the direction of growing arc length; 90 degrees to their left is out of the mouth."""
        heading = np.sign(length_mm) * np.interp(np.abs(length_mm), self._middle, self._heading)
        return np.stack([np.cos(heading), np.sin(heading)], axis=-1)

    def outward(self, length_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit normals (N, 2) towards lips and cheeks."""
        x, y = self.tangents(length_mm).T
        return np.stack([-y, x], axis=-1)
