"""Linear colour spaces of renderers, and their matrices from XYZ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.colour.cie import D50

Floats = NDArray[np.float64]
Chromaticity = tuple[float, float]

BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""Cone responses from XYZ of the Bradford adaptation (ICC.1:2022, annex E.3)."""


@dataclass(frozen=True)
class ColourSpace:
    """A linear space of red, green and blue."""

    name: str
    primaries: tuple[Chromaticity, Chromaticity, Chromaticity]
    """CIE 1931 x, y of red, green and blue."""
    white: Chromaticity
    """CIE 1931 x, y of (1, 1, 1)."""

    def xyz_from_rgb(self) -> Floats:
        """Matrix (3, 3) to XYZ with Y = 1 for the space's own white (SMPTE RP 177-1993, section 3.3): the primaries'
        XYZ as columns, scaled so that their sum is the white.
        """
        columns = np.stack([xyz_of_chromaticity(xy) for xy in self.primaries], axis=1)
        return np.asarray(columns * np.linalg.solve(columns, xyz_of_chromaticity(self.white)))

    def rgb_from_xyz(self, white: Floats = D50) -> Floats:
        """Matrix (3, 3) from XYZ under a white, which becomes (1, 1, 1), by the Bradford adaptation."""
        return np.asarray(np.linalg.inv(self.xyz_from_rgb()) @ adaptation(white, xyz_of_chromaticity(self.white)))


LINEAR_SRGB = ColourSpace("linear sRGB", ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)), (0.3127, 0.3290))
"""Primaries and white D65 of IEC 61966-2-1:1999, without its transfer curve: what Mitsuba, Blender and glTF take."""
ACESCG = ColourSpace("ACEScg", ((0.713, 0.293), (0.165, 0.830), (0.128, 0.044)), (0.32168, 0.33767))
"""Primaries AP1 and the white of ACES (Academy S-2014-004)."""
SPACES = (LINEAR_SRGB, ACESCG)


def xyz_of_chromaticity(xy: Chromaticity) -> Floats:
    """XYZ (3,) with Y = 1 of a chromaticity."""
    x, y = xy
    return np.array([x / y, 1.0, (1 - x - y) / y])


def adaptation(source: Floats, target: Floats) -> Floats:
    """Bradford matrix (3, 3) that takes XYZ under one white to XYZ under another."""
    return np.asarray(np.linalg.inv(BRADFORD) @ np.diag((BRADFORD @ target) / (BRADFORD @ source)) @ BRADFORD)
