"""A grid that tells for every place in a solid which way its surface is nearest: a normal, and the depth below it.

Connections aim through that part of the surface (``paths.aimed_connections``). They need no exact answer, but every
question at one place must have the same one.

The scenes of one tooth that a process builds share a grid, which takes most of a second to make.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from services.anatomy.distance import sample_triangles
from services.core.geometry import Mesh

CELL_MM = 0.15
"""Smallest size of a grid cell, mm."""
MAX_CELLS = 2_000_000
"""Largest number of grid cells; larger scenes have larger cells."""
SPACING_MM = 0.15
"""Largest distance between samples of the surface, mm."""
MAX_BEND = 0.7
"""Cosine of the angle between neighbouring faces below which a normal is not smoothed over their common edge."""

HIDDEN_MM = 1e6
"""Depth in mm below parts of the surface that lie in gums or in another tooth, through which nothing is aimed."""

_held: WeakValueDictionary[bytes, NearestFace] = WeakValueDictionary()
"""Grids of the scenes that this process holds, by content of the surface and of what surrounds it."""
Test = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]
"""Which points (N, 3) of a surface, with their outward normals (N, 3), lie hidden in another solid."""


def nearest_face_of(
    mesh: Mesh, around_mm: NDArray[np.float64] | None = None, hidden: Test | None = None
) -> NearestFace:
    """The grid of a surface, made unless another scene holds it.

    Args:
        around_mm: vertices of what surrounds it, and ``hidden`` tells which parts lie in that; None for air alone.
    """
    content = blake2b(repr((mesh.vertices_mm.shape, mesh.vertices_mm.dtype, mesh.faces.dtype)).encode())
    surroundings = b"" if around_mm is None else around_mm.tobytes()
    for part in (mesh.vertices_mm.tobytes(), mesh.faces.tobytes(), surroundings):
        content.update(part)
    found = _held.get(content.digest())
    if found is None:
        found = _held[content.digest()] = NearestFace(mesh, hidden)
    return found


class NearestFace:
    """Smoothed normal of the nearest part of a closed surface, and the depth below the plane through that part."""

    def __init__(self, mesh: Mesh, hidden: Test | None = None) -> None:
        from scipy.spatial import cKDTree

        low, extent = mesh.vertices_mm.min(axis=0), np.ptp(mesh.vertices_mm, axis=0)
        self._cell_mm = max(CELL_MM, float(np.cbrt(extent.prod() / MAX_CELLS)))
        self._shape = np.ceil(extent / self._cell_mm).astype(int) + 1
        points, owners = sample_triangles(mesh.vertices_mm[mesh.faces], SPACING_MM * self._cell_mm / CELL_MM)

        # Measure in the cells next to the surface; all others take over the answer of the nearest of these.
        near = np.zeros(self._shape, dtype=bool)
        near[tuple(np.floor((points - low) / self._cell_mm).astype(int).T)] = True
        near = ndimage.binary_dilation(near, iterations=2)
        places = np.stack(np.nonzero(near), axis=1)
        found = np.zeros(near.shape, dtype=np.int64)
        found[near] = cKDTree(points).query(low + self._cell_mm * (places + 0.5))[1]
        source = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
        sample = found[tuple(source)].reshape(-1)
        normals = _smoothed_normals(mesh)[owners]
        offsets = np.einsum("nk,nk->n", normals, points)
        if hidden is not None:
            offsets[hidden(points, normals)] = 2 * HIDDEN_MM
        columns = np.concatenate([normals, offsets[:, None]], axis=1)[sample]
        self._table = mi.Float(columns.astype(np.float32).reshape(-1))
        self._low = dr.opaque(mi.Point3f, low.tolist())
        dr.eval(self._table)

    def __call__(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """Outward unit normal, and depth in mm, not negative; beyond ``HIDDEN_MM`` below hidden parts."""
        place = mi.Point3f(point - self._low) * (1 / self._cell_mm)
        x, y, z = (mi.UInt32(dr.clip(place[k], 0, int(self._shape[k]) - 1)) for k in range(3))
        cell = (x * int(self._shape[1]) + y) * int(self._shape[2]) + z
        plane = dr.gather(mi.Vector4f, self._table, cell, active)
        normal = mi.Vector3f(plane.x, plane.y, plane.z)
        return normal, dr.maximum(plane.w - dr.dot(normal, mi.Vector3f(point)), 0)


def _smoothed_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals (F, 3) of faces, averaged by area with those neighbours that do not bend away much."""
    corners = mesh.vertices_mm[mesh.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-30)
    count = len(mesh.faces)
    touches = sparse.csr_matrix(
        (np.ones(3 * count), (np.repeat(np.arange(count), 3), mesh.faces.reshape(-1))),
        shape=(count, len(mesh.vertices_mm)),
    )
    pairs = (touches @ touches.T).tocoo()
    alike = np.einsum("nk,nk->n", normals[pairs.row], normals[pairs.col]) > MAX_BEND
    neighbours = sparse.csr_matrix((alike[alike], (pairs.row[alike], pairs.col[alike])), shape=(count, count))
    total = neighbours @ areas
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0, total / np.maximum(length, 1e-30), normals))
