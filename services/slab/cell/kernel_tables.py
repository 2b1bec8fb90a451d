"""A medium as the walk's kernel reads it: its values at the knots and an inverse distribution of scattering angles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import ANGLES_RAD, KNOTS, Material

Array = NDArray[np.float64]

CELLS_PER_KNOT = 8
"""Number of cells of cosine per interval of knots. Cosines are drawn uniformly within a cell; the weight that corrects
for it varies by about 1 % at this number."""
GUIDE = 4096
"""Number of entries of the table from a uniform number to the first cell that can hold it."""


class MediumTables(NamedTuple):
    """Arrays of a medium; cells (M,), guide (GUIDE,)."""

    scattering: Array
    extinction_per_mm: float
    albedo: float
    cumulative: Array
    """Probability up to the end of each cell (M,)."""
    cosines: Array
    """Edges of the cells (M + 1,)."""
    densities: Array
    """sigma_s times the density per sr with which a cell's directions are drawn (M,)."""
    guide: NDArray[np.int64]


def tables_of(material: Material) -> MediumTables:
    """Tables of a material."""
    angles = np.linspace(0, np.pi, (KNOTS - 1) * CELLS_PER_KNOT + 1)
    # 1 - cos without cancellation near the pole.
    spans = np.diff(2 * np.sin(angles / 2) ** 2)
    middles = np.interp((angles[1:] + angles[:-1]) / 2, ANGLES_RAD, material.scattering)
    masses = middles * spans
    probabilities = masses / masses.sum()
    cumulative = np.cumsum(probabilities)
    cumulative[-1] = 1.0
    guide = np.searchsorted(cumulative, np.arange(GUIDE) / GUIDE, side="right")
    sigma_s, sigma_t = material.scattering_per_mm, material.extinction_per_mm
    densities = sigma_s * probabilities / (2 * np.pi * spans)
    return MediumTables(material.scattering, sigma_t, sigma_s / sigma_t, cumulative, np.cos(angles), densities, guide)
