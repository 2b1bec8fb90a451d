"""Check that dentin lies inside enamel, with room for a ray's offset between the two surfaces.

Surfaces nearer to each other than the offset hide one another: a ray that crosses the first starts anew beyond the
second.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.distance import SurfaceDistance
from services.core.errors import MeshError
from services.core.geometry import Mesh

MAX_CHECKED = 64
"""Largest number of vertices whose winding number is computed, the farthest from the outer surface first."""


def require_nested(outer: Mesh, dentin: Mesh, gap_mm: float) -> None:
    """Refuse a dentin surface with vertices outside the outer surface, or within ``gap_mm`` of it.

    Raises:
        MeshError: says how many vertices, and by how much.
    """
    points = dentin.vertices_mm
    nearest, distance, face = SurfaceDistance(outer).closest(points)
    a, b, c = (outer.vertices_mm[outer.faces[face, k]] for k in range(3))
    above = np.einsum("ij,ij->i", points - nearest, np.cross(b - a, c - a)) > 0
    # Where the nearest point is a corner, a face's normal can mislead; the winding number cannot.
    suspects = np.flatnonzero(above)
    suspects = suspects[np.argsort(distance[suspects])[::-1][:MAX_CHECKED]]
    outside = suspects[winding_number(outer, points[suspects]) < 0.5]
    if len(outside):
        worst_mm = float(distance[outside].max())
        raise MeshError(
            f"The dentin surface passes through the outer surface, at its worst {worst_mm:.3g} mm beyond it; see"
            " whether both are in the same coordinates and of the same tooth, and move the dentin by"
            f" {worst_mm + gap_mm:.3g} mm inwards there."
        )
    touching = int(np.count_nonzero(distance < gap_mm))
    if touching:
        raise MeshError(
            f"The dentin surface touches the outer surface at {touching} of {len(points)} vertices; move it at least"
            f" {gap_mm:.2g} mm inside."
        )


def winding_number(mesh: Mesh, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Number of times a closed mesh winds around each point (N, 3): 1 inside, 0 outside (van Oosterom & Strackee 1983,
    Eq. 8).
    """
    winding = np.empty(len(points_mm))
    for k, point in enumerate(points_mm):
        a, b, c = (mesh.vertices_mm[mesh.faces[:, corner]] - point for corner in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        scale = (
            la * lb * lc
            + np.einsum("ij,ij->i", a, b) * lc
            + np.einsum("ij,ij->i", b, c) * la
            + np.einsum("ij,ij->i", c, a) * lb
        )
        winding[k] = np.arctan2(volume, scale).sum() / (2 * np.pi)
    return winding
