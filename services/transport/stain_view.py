"""Which texels of a stain texture the pixels of a view show."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Mesh
from services.transport.rays import Hits, RayScene
from services.transport.scene.recipe import View
from services.transport.scene.stain_uv import StainLayout, bilinear_texels

Array = NDArray[np.float64]

POINTS_PER_EDGE = 3
"""Points along each edge of a pixel at which the surface is looked up."""


def surface_uv(outer: Mesh, corners_uv: Array, hits: Hits) -> Array:
    """Texture coordinates (M, 2) of the M points that rays hit, for coordinates (F, 3, 2) of the faces' corners."""
    corners, points = outer.vertices_mm[outer.faces[hits.face[hits.hit]]], hits.points_mm[hits.hit]

    # Barycentric weights from the areas of the three triangles that a point forms with the edges.
    def doubled_area(a: Array, b: Array, c: Array) -> Array:
        return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))

    weights = np.stack(
        [doubled_area(points, corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]) for k in range(3)], axis=1
    )
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    return np.asarray(np.einsum("nc,ncd->nd", weights, corners_uv[hits.face[hits.hit]]))


def seen_texels(layout: StainLayout, view: View) -> Any:
    """Weights of the T texels in the light that each of the N pixels receives, as a sparse matrix (N, T) of the share
    of the pixel in which each is seen; a pixel's weights sum to the share of it that shows the surface.
    """
    from scipy import sparse

    scene, shape = RayScene(layout.outer), layout.index.shape
    steps = (np.arange(POINTS_PER_EDGE) + 0.5) / POINTS_PER_EDGE
    total = sparse.csr_matrix((len(view), len(layout.points_mm)))
    for x, y in ((x, y) for x in steps for y in steps):
        hits = scene.first_hits(*view.camera.rays(view.pixels[:, 0] + x, view.pixels[:, 1] + y))
        texels, weights = bilinear_texels(surface_uv(layout.outer, layout.corners_uv, hits), (shape[0], shape[1]))
        own = layout.index.reshape(-1)[texels]
        pixel = np.repeat(np.flatnonzero(hits.hit), 4).reshape(-1, 4)
        touched = own >= 0
        shares = weights[touched] / POINTS_PER_EDGE**2
        total += sparse.csr_matrix((shares, (pixel[touched], own[touched])), shape=total.shape)
    return total
