"""Which surface is visible at each place of a camera's image: an exact z-buffer of triangles, without a ray tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh

Floats = NDArray[np.float64]

NOTHING = -1
"""Number of the mesh where none is visible."""
SAMPLES_OF_A_BATCH = 200_000
"""Approximate number of pairs of a triangle and a sample that are held at once. Each takes about 200 bytes, so a batch
takes 40 MB, near the size of a processor's cache."""
ROUNDING = -1e-9
"""Smallest barycentric coordinate of a sample that counts as inside a triangle. It is below zero so that a sample on an
edge belongs to both adjacent triangles in spite of rounding."""


@dataclass(frozen=True)
class VisibleSurfaces:
    """The nearest surface at each sample of an image of H rows and W columns."""

    mesh: NDArray[np.int16]
    """Number of the visible mesh (H, W), ``NOTHING`` where there is none."""
    depth_mm: Floats
    """Depth along the camera's axis (H, W), infinite where there is none."""
    normal: NDArray[np.float32]
    """Unit normal in world axes (H, W, 3), zero where there is none; (0, 0, 3) where normals were not asked for."""


def visible_surfaces(
    camera: Camera,
    meshes: Sequence[Mesh],
    *,
    samples: tuple[int, int] | None = None,
    offset_px: float = 0.5,
    with_normals: bool = False,
) -> VisibleSurfaces:
    """Find the nearest surface at each sample.

    Triangles that face away from the camera are left out, because the meshes are closed solids, and so are triangles
    with a vertex behind the camera.

    Args:
        camera: pinhole camera.
        meshes: closed surfaces in world coordinates, mm.
        samples: rows and columns of samples; None for one per pixel.
        offset_px: samples lie at (column + offset, row + offset) in pixels; 0.5 is a pixel's centre.
        with_normals: whether normals are interpolated.
    """
    rows, columns = samples or camera.size[::-1]
    nearness = np.zeros(rows * columns)
    label = np.full(rows * columns, NOTHING, dtype=np.int16)
    normal = np.zeros((rows * columns if with_normals else 0, 3), dtype=np.float32)
    for number, mesh in enumerate(meshes):
        image, depth = camera.project(mesh.vertices_mm)
        faces = mesh.faces[(depth[mesh.faces] > 0).all(axis=1)]
        normals = vertex_normals(mesh) if with_normals else None
        corners = image[faces] - offset_px
        # Keep triangles that face the camera (y points down, so their area is negative) and touch the image.
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
        low = np.maximum(np.ceil(corners.min(axis=1)), 0).astype(np.int64)
        high = np.minimum(np.floor(corners.max(axis=1)), [columns - 1, rows - 1]).astype(np.int64)
        span = np.maximum(high - low + 1, 0)
        count = np.where(area < 0, span[:, 0] * span[:, 1], 0)
        for batch in _batches(np.flatnonzero(count), count):
            # Enumerate every sample inside each triangle's bounding box.
            triangle = np.repeat(batch, count[batch])
            step = np.arange(len(triangle)) - np.repeat(np.cumsum(count[batch]) - count[batch], count[batch])
            x, y = low[triangle, 0] + step % span[triangle, 0], low[triangle, 1] + step // span[triangle, 0]
            # Compute barycentric coordinates; edges count as inside, so that adjacent triangles leave no gap.
            x_from, y_from = x - corners[triangle, 0, 0], y - corners[triangle, 0, 1]
            b1 = (x_from * edge2[triangle, 1] - y_from * edge2[triangle, 0]) / area[triangle]
            b2 = (edge1[triangle, 0] * y_from - edge1[triangle, 1] * x_from) / area[triangle]
            b0 = 1 - b1 - b2
            inside = np.flatnonzero((b0 >= ROUNDING) & (b1 >= ROUNDING) & (b2 >= ROUNDING))
            triangle, sample = triangle[inside], (y * columns + x)[inside]
            barycentric = np.stack([b0[inside], b1[inside], b2[inside]], axis=1)
            # 1/depth is linear in the image, so weights over depth are perspective-correct.
            weights = barycentric / depth[faces[triangle]]
            inverse = weights.sum(axis=1)
            # Of the candidates for one sample keep the nearest: sorted by nearness, the last write wins.
            nearer = np.flatnonzero(inverse > nearness[sample])
            nearer = nearer[np.argsort(inverse[nearer], kind="stable")]
            sample = sample[nearer]
            nearness[sample] = inverse[nearer]
            label[sample] = number
            if normals is not None:
                normal[sample] = np.einsum("nk,nkd->nd", weights[nearer], normals[faces[triangle[nearer]]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    shape = (rows, columns)
    with np.errstate(divide="ignore"):
        depth_mm = (1 / nearness).reshape(shape)
    return VisibleSurfaces(label.reshape(shape), depth_mm, normal.reshape(*(shape if with_normals else (0, 0)), 3))


def vertex_normals(mesh: Mesh) -> Floats:
    """Unit normals (V, 3) at the vertices, averaged over adjacent faces with their areas as weights."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    normals = np.zeros_like(mesh.vertices_mm)
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, k], weighted[:, axis], minlength=len(normals))
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300), dtype=np.float64)


def _batches(triangles: NDArray[np.intp], count: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Split triangles into parts that enumerate about ``SAMPLES_OF_A_BATCH`` samples each."""
    total = np.cumsum(count[triangles])
    cuts = np.flatnonzero(np.diff(total // SAMPLES_OF_A_BATCH)) + 1
    return [part for part in np.split(triangles, cuts) if len(part)]
