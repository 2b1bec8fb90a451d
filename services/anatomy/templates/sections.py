"""Closed surfaces from stacked cross-sections: superellipses with evenly spread vertices, joined row by row."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh


def superellipse(
    half_x_mm: float, half_y_mm: float, columns: int, exponent: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices x, y (columns,) of |x / half_x|^n + |y / half_y|^n = 1, counter-clockwise from +x.

    They lie at equal steps of a sum of arc length and turning angle, so that neighbouring rows stay aligned and tight
    bends stay round.
    """
    cosine, sine = _directions(64 * columns + 1)
    radius = (np.abs(cosine / half_x_mm) ** exponent + np.abs(sine / half_y_mm) ** exponent) ** (-1 / exponent)
    x, y = radius * cosine, radius * sine
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    measure = arc / arc[-1] + 0.5 * (heading - heading[0]) / (heading[-1] - heading[0])
    at = np.linspace(measure[0], measure[-1], columns, endpoint=False)
    return np.interp(at, measure, x), np.interp(at, measure, y)


@cache
def _directions(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Cosines and sines (count,) of a full turn in equal steps.
    angle = np.linspace(0, 2 * np.pi, count)
    return np.cos(angle), np.sin(angle)


def close_rings(vertices_mm: NDArray[np.float64], rows: int, columns: int) -> Mesh:
    """Join rings to a closed surface with fans at the poles.

    It faces outward if the rings run counter-clockwise seen from the last pole.

    Args:
        vertices_mm: (rows · columns + 2, 3): the rings row by row, then the first and the last pole.
        rows, columns: number of rings, and of vertices in a ring.
    """
    first, last = np.arange(columns), (rows - 1) * columns + np.arange(columns)
    lids = _fan(first, rows * columns)[:, [0, 2, 1]], _fan(last, rows * columns + 1)
    return Mesh(vertices_mm, np.concatenate([_wall(rows, columns), *lids]).astype(np.int32))


def cover_rings(vertices_mm: NDArray[np.float64], rows: int, columns: int, thin: tuple[bool, bool]) -> Mesh:
    """Join rings to a closed surface whose first and last ring are flat.

    A thin ring is bridged straight across, because the long triangles of a fan would make its edge rough; other rings
    get a fan at their middle.

    Args:
        vertices_mm: (rows · columns, 3), the rings row by row.
        rows: number of rings.
        columns: number of vertices in a ring, even; vertices k and columns - k lie opposite each other, as
            ``superellipse`` places them.
        thin: whether the first and the last ring are thin.
    """
    faces, poles = [_wall(rows, columns)], [np.empty((0, 3))]
    for start, bridged, upward in ((0, thin[0], False), ((rows - 1) * columns, thin[1], True)):
        ring = start + np.arange(columns)
        if bridged:
            k = np.arange(columns // 2 + 1)
            near, far = ring[k], ring[-k]
            lid = _split_quads(near[:-1, None], near[1:, None], far[:-1, None], far[1:, None])
            lid = lid[(lid != np.roll(lid, 1, axis=1)).all(axis=1)]
        else:
            lid = _fan(ring, rows * columns + len(poles) - 1)
            poles.append(vertices_mm[ring].mean(axis=0, keepdims=True))
        faces.append(lid if upward else lid[:, ::-1])
    return Mesh(np.concatenate([vertices_mm, *poles]), np.concatenate(faces).astype(np.int32))


def _fan(ring: NDArray[np.int64], pole: int) -> NDArray[np.int64]:
    return np.stack([np.full(len(ring), pole), ring, np.roll(ring, -1)], axis=-1)


def _wall(rows: int, columns: int) -> NDArray[np.int64]:
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    return _split_quads(a, b, a + columns, b + columns)


def _split_quads(
    a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64], d: NDArray[np.int64]
) -> NDArray[np.int64]:
    # Triangles of quads with corners a, b below c, d, split along alternating diagonals.
    row, column = np.indices(a.shape)
    even = ((row + column) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, b, d], -1), np.stack([a, b, c], -1)).reshape(-1, 3)
    second = np.where(even, np.stack([a, d, c], -1), np.stack([b, d, c], -1)).reshape(-1, 3)
    return np.concatenate([first, second])
