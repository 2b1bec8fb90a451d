"""Which surface is visible at each place of a camera's image: an exact z-buffer of triangles, without a ray tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

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


def points_at(camera: Camera, depth_mm: NDArray[Any], y: NDArray[np.intp], x: NDArray[np.intp]) -> Floats:
    """World positions (..., 3) in mm of what the centres of pixels at rows y and columns x see at depths (...)."""
    pose = np.asarray(camera.camera_from_world)
    local = np.stack([x + 0.5, y + 0.5, np.ones(x.shape)], axis=-1) @ np.linalg.inv(np.asarray(camera.K)).T
    local *= depth_mm[..., None]
    return np.asarray((local - pose[:3, 3]) @ pose[:3, :3], dtype=np.float64)


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
        normals = vertex_normals(mesh)[faces] if with_normals else None
        corners = image[faces] - offset_px
        # Keep triangles that face the camera (y points down, so their area is negative) and touch the image.
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
        low = np.maximum(np.ceil(corners.min(axis=1)), 0).astype(np.int64)
        high = np.minimum(np.floor(corners.max(axis=1)), [columns - 1, rows - 1]).astype(np.int64)
        span = np.maximum(high - low + 1, 0)
        count = np.where(area < 0, span[:, 0] * span[:, 1], 0)
        for batch in _batches(np.flatnonzero(count), count):
            row = _rows_inside(batch, corners[:, 0], edge1, edge2, area, low, high)
            # Compute barycentric coordinates; edges count as inside, so that adjacent triangles leave no gap.
            member, step = _enumerate(row.length)
            x = row.first[member] + step
            x0, height1, height2, doubled_area, rise1, rise2 = row.constants[:, member]
            b1 = ((x - x0) * height2 - rise2) / doubled_area
            b2 = (rise1 - height1 * (x - x0)) / doubled_area
            b0 = 1 - b1 - b2
            inside = np.flatnonzero((b0 >= ROUNDING) & (b1 >= ROUNDING) & (b2 >= ROUNDING))
            member = member[inside]
            sample = row.y[member] * columns + x[inside]
            # 1/depth is linear in the image, so weights over depth are perspective-correct.
            weights = np.stack([b0[inside], b1[inside], b2[inside]]) / depth[faces[row.triangle].T][:, member]
            inverse = weights.sum(axis=0)
            # Of the candidates for one sample keep the nearest.
            nearer = np.flatnonzero(inverse > nearness[sample])
            np.maximum.at(nearness, sample[nearer], inverse[nearer])
            nearer = nearer[inverse[nearer] == nearness[sample[nearer]]]
            label[sample[nearer]] = number
            if normals is not None:
                of_corners = normals[row.triangle[member[nearer]]]
                mean = np.einsum("kn,nkd->nd", weights[:, nearer], of_corners).astype(np.float32)
                length = np.linalg.norm(mean, axis=1, keepdims=True)
                normal[sample[nearer]] = mean / np.maximum(length, 1e-30)
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


@dataclass(frozen=True)
class _Rows:
    """Rows of samples inside triangles, one triangle after the other; all arrays have one entry per row."""

    triangle: NDArray[np.intp]
    y: NDArray[np.int64]
    first: NDArray[np.int64]
    length: NDArray[np.int64]
    constants: Floats
    """What barycentric coordinates along a row are computed from: x of corner 0, heights of both edges, twice the area,
    and for both edges the width times the row's distance from corner 0 (6, rows)."""


def _rows_inside(
    triangles: NDArray[np.intp],
    corner: Floats,
    edge1: Floats,
    edge2: Floats,
    area: Floats,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
) -> _Rows:
    """Bound the columns of each row of samples that lie inside a triangle.

    Args:
        triangles: indices of triangles into the other arrays.
        corner: corner 0 of all triangles (F, 2), in samples.
        edge1: edge from corner 0 to corner 1 (F, 2).
        edge2: edge from corner 0 to corner 2 (F, 2).
        area: twice the signed area (F,).
        low: first column and row of each bounding box (F, 2).
        high: last column and row of each bounding box (F, 2).
    """
    owner, step = _enumerate(high[triangles, 1] - low[triangles, 1] + 1)
    triangle = triangles[owner]
    y = low[triangle, 1] + step
    y_from = y - corner[triangle, 1]
    height1, height2, doubled_area = edge1[triangle, 1], edge2[triangle, 1], area[triangle]
    rise1, rise2 = edge1[triangle, 0] * y_from, y_from * edge2[triangle, 0]
    # Along a row each barycentric coordinate is linear. Take twice the tolerance, so that rounding loses no sample.
    start = np.stack([doubled_area + rise2 - rise1, -rise2, rise1]) / doubled_area
    slope = np.stack([height1 - height2, height2, -height1]) / doubled_area
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = corner[triangle, 0] + (2 * ROUNDING - start) / slope
    first = np.where(slope > 0, np.ceil(crossing), low[triangle, 0]).max(axis=0)
    last = np.where(slope < 0, np.floor(crossing), high[triangle, 0]).min(axis=0)
    first = np.clip(first, low[triangle, 0], high[triangle, 0] + 1).astype(np.int64)
    last = np.clip(last, low[triangle, 0] - 1, high[triangle, 0]).astype(np.int64)
    constants = np.stack([corner[triangle, 0], height1, height2, doubled_area, rise1, rise2])
    return _Rows(triangle, y, first, np.maximum(last - first + 1, 0), constants)


def _enumerate(lengths: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index of the group, and place in the group, of each member of groups of the given lengths."""
    group = np.repeat(np.arange(len(lengths)), lengths)
    return group, np.arange(len(group)) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _batches(triangles: NDArray[np.intp], count: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Split triangles into parts that enumerate about ``SAMPLES_OF_A_BATCH`` samples each."""
    total = np.cumsum(count[triangles])
    cuts = np.flatnonzero(np.diff(total // SAMPLES_OF_A_BATCH)) + 1
    return [part for part in np.split(triangles, cuts) if len(part)]
