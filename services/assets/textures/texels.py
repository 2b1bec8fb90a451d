"""Which point of a surface each texel of its texture shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.assets.people_mesh import PeopleMesh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Texels:
    """The T texels of a texture whose centres lie in a triangle of the chart."""

    index: NDArray[np.int64]
    """For each texel (H, W) the number of the covered one whose value it takes: itself, or the nearest, so that a
    look-up near a seam reads no colour of the background."""
    points_mm: Array
    """Points (T, 3) of the surface at their centres."""
    uv: Array
    """Texture coordinates (T, 2) of their centres."""

    def picture(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Values (T, ...) at the covered texels as a picture (H, W, ...)."""
        return np.asarray(values, dtype=np.float64)[self.index]


def texels_of(mesh: PeopleMesh) -> Texels:
    """The texels of a mesh's texture."""
    from scipy.ndimage import distance_transform_edt

    height, width = mesh.size
    # Corners in texels, where the centre of the first texel is 0, 0.
    corners = mesh.corners_uv * [width, height] - 0.5
    low = np.maximum(np.ceil(corners.min(axis=1)).astype(np.int64), 0)
    high = np.minimum(np.floor(corners.max(axis=1)).astype(np.int64), [width - 1, height - 1])
    columns, rows = np.maximum(high - low + 1, 0).T
    # Every centre in the box around each triangle, then those inside it.
    face = np.repeat(np.arange(len(corners)), columns * rows)
    within = np.arange(len(face)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    centre = low[face] + np.stack([within % columns[face], within // columns[face]], axis=1)
    weights = _barycentric(corners[face], centre.astype(np.float64))
    inside = (weights >= -1e-9).all(axis=1)
    face, centre, weights = face[inside], centre[inside], weights[inside]
    number = centre[:, 1] * width + centre[:, 0]
    chosen, first = np.unique(number, return_index=True)  # a centre on an edge lies in two triangles
    index = np.full(height * width, -1)
    index[chosen] = np.arange(len(chosen))
    nearest = distance_transform_edt(index.reshape(height, width) < 0, return_distances=False, return_indices=True)
    return Texels(
        index.reshape(height, width)[tuple(nearest)],
        np.einsum("tc,tcd->td", weights[first], mesh.vertices_mm[mesh.faces[face[first]]]),
        (centre[first] + 0.5) / [width, height],
    )


def _barycentric(corners: Array, points: Array) -> Array:
    """Weights (N, 3) of the corners (N, 3, 2) at points (N, 2); NaN, which lies nowhere, in a triangle without area."""

    def cross(a: Array, b: Array) -> Array:
        return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    sides = [corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)]
    whole = cross(sides[0], sides[1])
    parts = np.stack([cross(sides[k], points - corners[:, (k + 1) % 3]) for k in range(3)], axis=1)
    return np.divide(parts, whole[:, None], out=np.full_like(parts, np.nan), where=whole[:, None] != 0)
