"""Naive surface nets (Gibson 1998): a closed, evenly spaced triangle mesh of a level set."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

Field = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def surface_net(
    field: Field, low_mm: NDArray[np.float64], high_mm: NDArray[np.float64], pitch_mm: float, level: float
) -> Mesh:
    """Extract the surface where ``field`` equals ``level``, oriented outward from the larger values.

    Args:
        field: function of points (N, 3) in mm; values above ``level`` must not touch the bounds.
        low_mm, high_mm: bounds (3,) of the grid.
        pitch_mm: distance between grid points.
        level: value on the surface.
    """
    shape = np.ceil((high_mm - low_mm) / pitch_mm).astype(int) + 1
    index = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1)
    value = (field((low_mm + pitch_mm * index).reshape(-1, 3)) - level).reshape(tuple(shape))
    above = value > 0

    # Place one vertex in each cell that the surface crosses: the mean of the crossings on its twelve edges.
    cells = tuple(shape - 1)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for offset in ((0, 0), (0, 1), (1, 0), (1, 1)):
            start = np.zeros(3, dtype=int)
            start[others] = offset
            stop = start.copy()
            stop[axis] += 1
            a, b = (
                value[tuple(slice(o, o + n) for o, n in zip(corner, cells, strict=True))] for corner in (start, stop)
            )
            crossed = (a > 0) != (b > 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                fraction = np.where(crossed, a / (a - b), 0.0)
            crossing = np.broadcast_to(start.astype(float), (*cells, 3)).copy()
            crossing[..., axis] += fraction
            total += np.where(crossed[..., None], crossing, 0.0)
            count += crossed
    mixed = count > 0
    number = np.full(cells, -1)
    number[mixed] = np.arange(np.count_nonzero(mixed))
    vertices = low_mm + pitch_mm * (index[:-1, :-1, :-1][mixed] + total[mixed] / count[mixed][:, None])

    # Make one quad for each crossed grid edge, which joins the four cells around it, and split it along its shorter
    # diagonal.
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        step_u, step_v = np.eye(3, dtype=int)[u], np.eye(3, dtype=int)[v]
        ahead = np.eye(3, dtype=int)[axis]
        edges = np.argwhere(
            above[tuple(slice(0, n - k) for n, k in zip(shape, ahead, strict=True))]
            != above[tuple(slice(k, None) for k in ahead)]
        )
        around = [number[tuple((edges - a * step_u - b * step_v).T)] for a, b in ((1, 1), (0, 1), (0, 0), (1, 0))]
        quad = np.stack(around, axis=-1)
        falling = above[tuple(edges.T)]
        quads.append(np.where(falling[:, None], quad, quad[:, ::-1]))
    quad = np.concatenate(quads)
    corners = vertices[quad]
    first = np.linalg.norm(corners[:, 0] - corners[:, 2], axis=1) <= np.linalg.norm(
        corners[:, 1] - corners[:, 3], axis=1
    )
    split = np.where(first[:, None], quad[:, [0, 1, 2, 0, 2, 3]], quad[:, [1, 2, 3, 1, 3, 0]])
    return Mesh(vertices, split.reshape(-1, 3).astype(np.int32))
