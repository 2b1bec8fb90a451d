"""Visibility of teeth in a camera's image: a z-buffer of triangles at the image's resolution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.pose import Floats
from services.core.geometry import Camera, Mesh

NOTHING = -1
SAMPLES_AT_ONCE = 2_000_000
"""Number of pairs of a triangle and a pixel that are held in memory at once: some 100 MB."""
ROUNDING = -1e-9
"""Smallest barycentric coordinate that counts as inside; below 0, so that rounding leaves no gap between neighbouring
triangles."""


def visible_surfaces(camera: Camera, meshes: Sequence[Mesh]) -> tuple[NDArray[np.int16], Floats]:
    """Return the number (H, W) of the mesh that is visible at each pixel's centre, -1 for none, and its depth in mm,
    infinite for none.

    Triangles that face away from the camera are skipped, because the meshes are closed solids. A mesh with a vertex
    behind the camera is skipped as a whole.
    """
    width, height = camera.size
    inverse = np.zeros(width * height)
    label = np.full(width * height, NOTHING, dtype=np.int16)
    for number, mesh in enumerate(meshes):
        image, depth = camera.project(mesh.vertices_mm)
        if not (depth > 0).all():
            continue
        corners = image[mesh.faces] - 0.5
        one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
        low = np.maximum(np.ceil(corners.min(axis=1)), 0).astype(np.int64)
        high = np.minimum(np.floor(corners.max(axis=1)), [width - 1, height - 1]).astype(np.int64)
        span = np.maximum(high - low + 1, 0)
        # The image's y axis points down, so triangles that face the camera have negative areas.
        count = np.where(area < 0, span[:, 0] * span[:, 1], 0)
        kept = np.flatnonzero(count)
        parts = np.flatnonzero(np.diff(np.cumsum(count[kept]) // SAMPLES_AT_ONCE)) + 1
        for part in np.split(kept, parts):
            triangle = np.repeat(part, count[part])
            step = np.arange(len(triangle)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
            x, y = low[triangle, 0] + step % span[triangle, 0], low[triangle, 1] + step // span[triangle, 0]
            offset = np.stack([x, y], axis=1) - corners[triangle, 0]
            b1 = (offset[:, 0] * two[triangle, 1] - offset[:, 1] * two[triangle, 0]) / area[triangle]
            b2 = (one[triangle, 0] * offset[:, 1] - one[triangle, 1] * offset[:, 0]) / area[triangle]
            share = np.stack([1 - b1 - b2, b1, b2], axis=1)
            inside = (share >= ROUNDING).all(axis=1)
            # Interpolate the inverse of depth, which is linear in the image. Among several hits of a pixel write the
            # nearest last.
            nearness = (share[inside] / depth[mesh.faces[triangle[inside]]]).sum(axis=1)
            sample = (y * width + x)[inside]
            nearer = np.flatnonzero(nearness > inverse[sample])
            nearer = nearer[np.argsort(nearness[nearer], kind="stable")]
            inverse[sample[nearer]] = nearness[nearer]
            label[sample[nearer]] = number
    with np.errstate(divide="ignore"):
        return label.reshape(height, width), (1 / inverse).reshape(height, width)
