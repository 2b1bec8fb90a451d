"""Surface that each pixel of a camera sees, by an exact z-buffer of the scanned meshes; it needs no ray tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
# Approximate number of candidate (triangle, sample) pairs held at once. Each takes about 200 bytes, so a batch takes
# 40 MB, near the size of a processor's cache
BATCH = 200_000
# Smallest barycentric coordinate of a sample that counts as inside a triangle. It is below zero so that a sample on an
# edge belongs to both adjacent triangles in spite of rounding
EDGE = -1e-9


@dataclass(frozen=True)
class Footprint:
    """Surfaces that one camera sees, by pixel.

    Attributes:
        mesh: (H, W) number of the mesh seen at the pixel's centre, -1 where none is.
        depth_mm: (H, W) depth of the nearest surface along the camera's axis, occluders included; infinite where there
            is none.
        normal: (H, W, 3) unit normal of that surface in world axes; zero where there is none.
        covered: (H, W) whether the pixel's centre and its four corners all see one of the meshes.
    """

    mesh: NDArray[np.int16]
    depth_mm: NDArray[np.float32]
    normal: NDArray[np.float32]
    covered: BoolArray

    def points_mm(self, camera: Camera, rows: slice) -> NDArray[np.float32]:
        """World positions (rows, width, 3) in mm of the visible surface; NaN where no mesh is seen."""
        height, width = self.mesh.shape
        y, x = np.mgrid[0:height, 0:width][:, rows]
        points = self.points_at(camera, y, x)
        points[self.mesh[rows] < 0] = np.nan
        return points.astype(np.float32)

    def points_at(self, camera: Camera, y: NDArray[np.intp], x: NDArray[np.intp]) -> FloatArray:
        """World positions (..., 3) in mm of the surface that the pixels at rows y and columns x (...) see."""
        pose = np.asarray(camera.camera_from_world)
        local = np.stack([x + 0.5, y + 0.5, np.ones(x.shape)], axis=-1) @ np.linalg.inv(np.asarray(camera.K)).T
        local *= np.where(self.mesh[y, x] >= 0, self.depth_mm[y, x], 0)[..., None]
        return np.asarray((local - pose[:3, 3]) @ pose[:3, :3], dtype=np.float64)


def project(camera: Camera, teeth: Sequence[Mesh], occluders: Sequence[Mesh] = ()) -> Footprint:
    """Project teeth into a camera; ``occluders`` hide them and are not labelled.

    A pixel is ``covered`` where its centre and its four corners see a tooth, so that no light from beside the teeth
    enters it. A mesh with a vertex behind the camera is left out.
    """
    width, height = camera.size
    meshes = (*teeth, *occluders)
    mesh, depth, normal = _rasterise(camera, meshes, (height, width), 0.5)
    mesh[mesh >= len(teeth)] = -1
    corner = _rasterise(camera, meshes, (height + 1, width + 1), 0.0, with_normals=False)[0]
    corners = (corner >= 0) & (corner < len(teeth))
    covered = corners[:-1, :-1] & corners[:-1, 1:] & corners[1:, :-1] & corners[1:, 1:] & (mesh >= 0)
    return Footprint(mesh, depth, normal, covered)


def vertex_normals(mesh: Mesh) -> FloatArray:
    """Unit normals (V, 3) at the vertices, averaged over adjacent faces with their areas as weights."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    normals = np.zeros_like(mesh.vertices_mm)
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, k], weighted[:, axis], minlength=len(normals))
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300), dtype=np.float64)


def _rasterise(
    camera: Camera, meshes: Sequence[Mesh], shape: tuple[int, int], offset_px: float, *, with_normals: bool = True
) -> tuple[NDArray[np.int16], NDArray[np.float32], NDArray[np.float32]]:
    """Find the nearest mesh, its depth in mm and, on request, its interpolated normal at the sample points.

    Sample points lie at (column + offset, row + offset) in pixels.
    """
    rows, columns = shape
    nearness = np.zeros(rows * columns)
    label = np.full(rows * columns, -1, dtype=np.int16)
    normal = np.zeros((rows * columns if with_normals else 0, 3), dtype=np.float32)
    for index, mesh in enumerate(meshes):
        image, depth = camera.project(mesh.vertices_mm)
        if not (depth > 0).all():
            continue
        normals = vertex_normals(mesh)
        corners = image[mesh.faces] - offset_px
        # Keep triangles that face the camera (y points down, so their area is negative) and touch the image
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
        low = np.maximum(np.ceil(corners.min(axis=1)), 0).astype(np.int64)
        high = np.minimum(np.floor(corners.max(axis=1)), [columns - 1, rows - 1]).astype(np.int64)
        span = np.maximum(high - low + 1, 0)
        count = np.where(area < 0, span[:, 0] * span[:, 1], 0)
        kept = np.flatnonzero(count)
        for batch in _batches(kept, count):
            # Enumerate every sample inside each triangle's bounding box
            triangle = np.repeat(batch, count[batch])
            step = np.arange(len(triangle)) - np.repeat(np.cumsum(count[batch]) - count[batch], count[batch])
            x, y = low[triangle, 0] + step % span[triangle, 0], low[triangle, 1] + step // span[triangle, 0]
            # Compute barycentric coordinates; edges count as inside so that adjacent triangles leave no gap
            x_from, y_from = x - corners[triangle, 0, 0], y - corners[triangle, 0, 1]
            b1 = (x_from * edge2[triangle, 1] - y_from * edge2[triangle, 0]) / area[triangle]
            b2 = (edge1[triangle, 0] * y_from - edge1[triangle, 1] * x_from) / area[triangle]
            b0 = 1 - b1 - b2
            inside = np.flatnonzero((b0 >= EDGE) & (b1 >= EDGE) & (b2 >= EDGE))
            triangle, sample = triangle[inside], (y * columns + x)[inside]
            barycentric = np.stack([b0[inside], b1[inside], b2[inside]], axis=1)
            # 1/depth is linear on the image, so weights over depth are perspective-correct
            weights = barycentric / depth[mesh.faces[triangle]]
            inverse = weights.sum(axis=1)
            # Of the candidates for one sample keep the nearest: sorted by nearness, the last write wins
            nearer = np.flatnonzero(inverse > nearness[sample])
            nearer = nearer[np.argsort(inverse[nearer], kind="stable")]
            sample = sample[nearer]
            nearness[sample] = inverse[nearer]
            label[sample] = index
            if with_normals:
                normal[sample] = np.einsum("nk,nkd->nd", weights[nearer], normals[mesh.faces[triangle[nearer]]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    with np.errstate(divide="ignore"):
        depth_mm = (1 / nearness).astype(np.float32)
    return label.reshape(shape), depth_mm.reshape(shape), normal.reshape(*(shape if with_normals else (0, 0)), 3)


def _batches(triangles: NDArray[np.intp], count: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Split triangles into parts that enumerate about BATCH samples each."""
    total = np.cumsum(count[triangles])
    return [part for part in np.split(triangles, np.flatnonzero(np.diff(total // BATCH)) + 1) if len(part)]
