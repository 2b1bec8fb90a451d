"""A surface as people's programs expect it: one normal and one texture coordinate a vertex."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh

MAX_CHART_SHARE = 0.1
"""Largest chart, as a share of the surface."""
MAX_CHART_FACES = 2000
"""Mean number of triangles in a largest chart. xatlas grows a chart in a time that rises faster than its triangles: a
dentin of 31,000 took 13 s in charts of any size and ended with 280 of them, and 4 s with charts of this size."""


@dataclass(frozen=True)
class PeopleMesh:
    """A triangle mesh whose vertices on a seam of the texture are held once for each side of it."""

    vertices_mm: NDArray[np.float64]
    """Positions (V, 3), mm."""
    normals: NDArray[np.float64]
    """Unit normals (V, 3), equal on both sides of a seam."""
    uv: NDArray[np.float64]
    """Texture coordinates (V, 2), 0 to 1; no two triangles overlap. The first row of a picture lies at v = 0."""
    faces: NDArray[np.int64]
    """Vertices (F, 3) of the triangles, counter-clockwise seen from outside."""
    size: tuple[int, int]
    """Height and width of a texture for which the charts were laid out, texels."""

    @property
    def corners_uv(self) -> NDArray[np.float64]:
        """Texture coordinates (F, 3, 2) of the faces' corners."""
        return np.asarray(self.uv[self.faces])

    def texel_edges_mm(self) -> NDArray[np.float64]:
        """Edge (F,) of a square as large as a texel on each face, mm."""
        on_surface = _doubled_areas(self.vertices_mm[self.faces])
        height, width = self.size
        in_texels = _doubled_areas(self.corners_uv * [width, height])
        return np.asarray(np.sqrt(on_surface / np.maximum(in_texels, 1e-300)))


def people_mesh(mesh: Mesh, texel_mm: float | None = None) -> PeopleMesh:
    """Smooth normals and a chart without overlaps (by xatlas) for a surface.

    Args:
        mesh: the surface.
        texel_mm: edge of a texel on the surface; None where no texture is made.
    """
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.uint32))
    packing, charts = xatlas.PackOptions(), xatlas.ChartOptions()
    packing.padding, packing.bilinear = 2, True
    if texel_mm is not None:
        packing.texels_per_unit = 1 / texel_mm
    share = min(MAX_CHART_SHARE, MAX_CHART_FACES / len(mesh.faces))
    charts.max_chart_area = share * float(_doubled_areas(mesh.vertices_mm[mesh.faces]).sum()) / 2
    atlas.generate(charts, packing)
    source, faces, uv = atlas[0]
    return _split(mesh, np.asarray(source), np.asarray(faces), np.asarray(uv), (int(atlas.height), int(atlas.width)))


def mapped_people_mesh(mesh: Mesh, corners_uv: NDArray[np.float64], size: tuple[int, int]) -> PeopleMesh:
    """Smooth normals for a surface that has a chart already.

    Args:
        mesh: the surface.
        corners_uv: texture coordinates (F, 3, 2) of its faces' corners.
        size: height and width of a texture.
    """
    corners = np.concatenate([mesh.faces.reshape(-1, 1), corners_uv.reshape(-1, 2)], axis=1)
    split, index = np.unique(corners, axis=0, return_inverse=True)
    return _split(mesh, split[:, 0], index.reshape(-1, 3), split[:, 1:], size)


def _split(
    mesh: Mesh, source: NDArray[Any], faces: NDArray[Any], uv: NDArray[Any], size: tuple[int, int]
) -> PeopleMesh:
    source = source.astype(np.int64)
    return PeopleMesh(
        mesh.vertices_mm[source],
        smooth_normals(mesh)[source],
        np.asarray(uv, dtype=np.float64),
        np.asarray(faces, dtype=np.int64),
        size,
    )


def _doubled_areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the areas (F,) of triangles with corners (F, 3, 2) or (F, 3, 3)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    aa, bb, ab = (np.einsum("ij,ij->i", *pair) for pair in ((a, a), (b, b), (a, b)))
    return np.asarray(np.sqrt(np.maximum(aa * bb - ab**2, 0.0)))


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
