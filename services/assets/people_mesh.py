"""A surface as people's programs expect it: one normal and one texture coordinate a vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh


@dataclass(frozen=True)
class PeopleMesh:
    """A triangle mesh whose vertices on a seam of the texture are held once for each side of it."""

    vertices_mm: NDArray[np.float64]
    """Positions (V, 3), mm."""
    normals: NDArray[np.float64]
    """Unit normals (V, 3), equal on both sides of a seam."""
    uv: NDArray[np.float64]
    """Texture coordinates (V, 2), 0 to 1; no two triangles overlap."""
    faces: NDArray[np.int64]
    """Vertices (F, 3) of the triangles, counter-clockwise seen from outside."""


def people_mesh(mesh: Mesh) -> PeopleMesh:
    """Smooth normals and a chart without overlaps (by xatlas) for a surface."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.padding, packing.bilinear = 2, True
    atlas.generate(pack_options=packing)
    source, faces, uv = atlas[0]
    source = np.asarray(source, dtype=np.int64)
    return PeopleMesh(
        mesh.vertices_mm[source],
        smooth_normals(mesh)[source],
        np.asarray(uv, dtype=np.float64),
        np.asarray(faces, dtype=np.int64),
    )


def smooth_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals (V, 3): the mean of the faces' normals, weighted by the angle of each face at the vertex (Thürmer
    and Wüthrich 1998), so that it does not depend on how a plane is cut into triangles.
    """
    corners = mesh.vertices_mm[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    summed = np.zeros_like(mesh.vertices_mm)
    for k in range(3):
        a, b = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        angle = np.arccos(np.clip(np.einsum("ij,ij->i", a, b) / np.maximum(lengths, 1e-300), -1, 1))
        np.add.at(summed, mesh.faces[:, k], angle[:, None] * normals)
    return np.asarray(summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-300))
