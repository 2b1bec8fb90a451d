"""The dental arch: a superellipse on which teeth stand, measured by its arc length from the midline.

Jaw frame: x to the patient's left, y forward, z occlusal (an upper jaw's teeth point along +z, down), mm; the occlusal
plane is z = 0, the midline x = 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HALF_WIDTH_MM = 25.5
DEPTH_MM = 47.0
"""With the half width, gives second molars 49 mm apart at their middles, and the arc length that an average upper jaw's
teeth need."""
EXPONENT = 2.2
"""Above 2 the front is flatter than an ellipse's."""
STRAIGHT_MM = 20.0
"""By which the arch runs on straight back behind its widest place."""
FORWARD_MM = 22.0
"""y of the arch at the midline: the jaw's middle is the origin."""
STEPS = 8000


class Arch:
    """The curve through the middles of the teeth; arc length is positive on the patient's left."""

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
        """Points (N, 2), x and y, at signed arc lengths (N,)."""
        away = np.abs(length_mm)
        return np.stack(
            [np.sign(length_mm) * np.interp(away, self._length, self._x), np.interp(away, self._length, self._y)],
            axis=-1,
        )

    def tangents(self, length_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit directions (N, 2) of growing arc length; turned left by a right angle they point out of the mouth."""
        heading = np.sign(length_mm) * np.interp(np.abs(length_mm), self._middle, self._heading)
        return np.stack([np.cos(heading), np.sin(heading)], axis=-1)

    def outward(self, length_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit normals (N, 2) towards lips and cheeks."""
        x, y = self.tangents(length_mm).T
        return np.stack([-y, x], axis=-1)
