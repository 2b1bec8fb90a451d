"""Phase tables for tests, and their distribution in double precision."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.phase_table import PhaseTable

TENT_SPACING_RAD = math.pi / 199


def over_equal_angles(nodes: int, values: dict[int, float], floor: float = 0.0) -> PhaseTable:
    """A phase table at equally spaced angles with given values at some nodes and ``floor`` elsewhere. Negative indices
    count from the end.
    """
    column = np.full(nodes, floor)
    for node, value in values.items():
        column[node] = value
    return PhaseTable(tuple(np.linspace(0, math.pi, nodes).tolist()), tuple(column.tolist()))


def over_equal_cosines(values: NDArray[np.float64]) -> PhaseTable:
    """A phase table at equally spaced cosines from 1 to -1, the nodes of Mitsuba's ``tabphase`` in reverse order."""
    return PhaseTable(tuple(np.arccos(np.linspace(1, -1, len(values))).tolist()), tuple(values.tolist()))


def henyey_greenstein(g: float, spacing: float) -> tuple[PhaseTable, float]:
    """A table of the Henyey-Greenstein phase function and a bound of the relative error of its interpolated values. The
    nodes x = (1 - |g|)^2 / 2|g| + 1 - cos grow geometrically, by ``spacing`` in log x.

    p ~ x^-1.5 is convex, so a chord lies above it, by at most p'' dx^2 / 8 = 15/32 (dx / x)^2 p; normalising takes at
    most as much away.
    """
    a = abs(g)
    nearest = (1 - a) ** 2 / (2 * a)
    x = np.geomspace(nearest, nearest + 2, math.ceil(math.log1p(2 / nearest) / spacing) + 1)
    m = np.clip(x - nearest, 0, 2)
    m[-1] = 2
    angles, values = 2 * np.arcsin(np.sqrt(m / 2)), x**-1.5
    if g < 0:
        angles, values = math.pi - angles[::-1], values[::-1]
        angles[0] = 0.0
    return PhaseTable(tuple(angles.tolist()), tuple(values.tolist())), 15 / 32 * math.expm1(spacing) ** 2


def density(table: PhaseTable, angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of the table at angles, interpolated linearly in the cosine."""
    return np.interp(haversine(angle_rad), haversine(np.array(table.angles_rad)), np.array(table.values))


def cumulative(table: PhaseTable, angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of light scattered by less than an angle. The trapezoidal rule is exact, because the density is linear."""
    nodes, values = haversine(np.array(table.angles_rad)), np.array(table.values)
    masses = np.concatenate([[0.0], np.cumsum(2 * math.pi * np.diff(nodes) * (values[1:] + values[:-1]))])
    x = haversine(angle_rad)
    k = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    return masses[k] + 2 * math.pi * (x - nodes[k]) * (values[k] + density(table, angle_rad))


def haversine(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """(1 - cos) / 2."""
    return np.sin(0.5 * angle_rad) ** 2
