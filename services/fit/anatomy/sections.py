"""Closed surfaces from stacked cross-sections: superellipses with evenly spread vertices, joined row by row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh


def superellipse(half_x_mm: float, half_y_mm: float, columns: int, exponent: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices x, y (columns,) of |x / half_x|^n + |y / half_y|^n = 1, counter-clockwise from +x.

    They lie at equal steps of arc length plus turning: neighbouring rows stay aligned and tight bends stay round.
    """
    angle = np.linspace(0, 2 * np.pi, 64 * columns + 1)
    radius = (np.abs(np.cos(angle) / half_x_mm) ** exponent + np.abs(np.sin(angle) / half_y_mm) ** exponent) ** (-1 / exponent)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    measure = arc / arc[-1] + 0.5 * (heading - heading[0]) / (heading[-1] - heading[0])
    at = np.linspace(measure[0], measure[-1], columns, endpoint=False)
    return np.interp(at, measure, x), np.interp(at, measure, y)


def close_rings(vertices_mm: NDArray[np.float64], rows: int, columns: int) -> Mesh:
    """Join rings (rows x columns vertices, then the first and the last pole) to a closed surface.

    It faces outward where rings run counter-clockwise seen from the last pole.
    """
    # Quads between rows split alternately, fans at the two poles.
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    even = ((row + column) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, b, d], -1), np.stack([a, b, c], -1)).reshape(-1, 3)
    second = np.where(even, np.stack([a, d, c], -1), np.stack([b, d, c], -1)).reshape(-1, 3)
    ring = np.arange(columns)
    after = (ring + 1) % columns
    last = (rows - 1) * columns
    bottom = np.stack([np.full(columns, rows * columns), after, ring], -1)
    lid = np.stack([np.full(columns, rows * columns + 1), last + ring, last + after], -1)
    return Mesh(vertices_mm, np.concatenate([first, second, bottom, lid]).astype(np.int32))
