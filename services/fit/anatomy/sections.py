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
    """Join rings (rows x columns vertices, then the first and the last pole) to a closed surface, with fans at the poles.

    It faces outward where rings run counter-clockwise seen from the last pole.
    """
    ring = np.arange(columns)
    after = (ring + 1) % columns
    last = (rows - 1) * columns
    bottom = np.stack([np.full(columns, rows * columns), after, ring], -1)
    lid = np.stack([np.full(columns, rows * columns + 1), last + ring, last + after], -1)
    return Mesh(vertices_mm, np.concatenate([_wall(rows, columns), bottom, lid]).astype(np.int32))


def cover_rings(vertices_mm: NDArray[np.float64], rows: int, columns: int, strips: tuple[int, int]) -> Mesh:
    """Join rings (rows x columns vertices) to a closed surface, with strips along x over the first and the last.

    Unlike a fan, strips make even triangles over a long and thin ring, and over a wide one.

    Args:
        columns: even; vertices k and columns - k lie opposite each other, as ``superellipse`` puts them.
        strips: number over the first and over the last ring.
    """
    half, last = columns // 2, (rows - 1) * columns
    vertices, faces = [vertices_mm], [_wall(rows, columns)]
    used = len(vertices_mm)
    for start, count, upward in ((0, strips[0], False), (last, strips[1], True)):
        # Grid of places: one line of vertices from each k to its opposite; at both ends of the ring a line is a single vertex.
        k, share = np.arange(half + 1), np.arange(count + 1) / count
        near, far = vertices_mm[start + k], vertices_mm[start + (columns - k) % columns]
        inner = near[1:-1, None] + share[1:-1, None] * (far - near)[1:-1, None]
        place = np.empty((half + 1, count + 1), dtype=np.int64)
        place[:, 0], place[:, -1] = start + k, start + (columns - k) % columns
        place[[0, -1], 1:-1] = place[[0, -1], :1]
        place[1:-1, 1:-1] = used + np.arange(inner.shape[0] * inner.shape[1]).reshape(inner.shape[:2])
        used += inner.shape[0] * inner.shape[1]
        vertices.append(inner.reshape(-1, 3))
        lid = _split_quads(place[:-1, :-1], place[1:, :-1], place[:-1, 1:], place[1:, 1:])
        lid = lid[(lid != np.roll(lid, 1, axis=1)).all(axis=1)]
        faces.append(lid if upward else lid[:, ::-1])
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))


def _wall(rows: int, columns: int) -> NDArray[np.int64]:
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    return _split_quads(a, b, a + columns, b + columns)


def _split_quads(a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64], d: NDArray[np.int64]) -> NDArray[np.int64]:
    # Quads with corners a b below c d, split alternately.
    row, column = np.indices(a.shape)
    even = ((row + column) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, b, d], -1), np.stack([a, b, c], -1)).reshape(-1, 3)
    second = np.where(even, np.stack([a, d, c], -1), np.stack([b, d, c], -1)).reshape(-1, 3)
    return np.concatenate([first, second])
