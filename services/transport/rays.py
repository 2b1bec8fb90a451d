"""First surface points along a camera's pixel rays, found by Mitsuba's ray tracer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Mesh
from services.transport.platform import prepare_device
from services.transport.scene.mitsuba_mesh import new_mesh


@dataclass(frozen=True)
class Hits:
    """Nearest intersections of N rays."""

    hit: NDArray[np.bool_]
    """(N,) whether the ray hit a mesh."""
    points_mm: NDArray[np.float64]
    """(N, 3); meaningless where no mesh was hit."""
    normals: NDArray[np.float64]
    """(N, 3) unit face normals, outward."""
    mesh: NDArray[np.int64]
    """(N,) index of the mesh that was hit, -1 for none."""
    face: NDArray[np.int64]
    """(N,) index of the face within that mesh."""


class RayScene:
    """Closed meshes for ray intersection."""

    def __init__(self, *meshes: Mesh) -> None:
        prepare_device()
        import mitsuba as mi

        self._meshes = meshes
        self._first_face = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
        vertices = np.concatenate([mesh.vertices_mm for mesh in meshes])
        first_vertex = np.cumsum([0] + [len(mesh.vertices_mm) for mesh in meshes])
        self._faces = np.concatenate([mesh.faces + first for mesh, first in zip(meshes, first_vertex, strict=False)])
        self._vertices = vertices
        self._scene = mi.load_dict({"type": "scene", "surface": new_mesh("surface", vertices, self._faces)})

    def first_hits(self, origins_mm: NDArray[np.float64], directions: NDArray[np.float64]) -> Hits:
        """Nearest hits of rays from ``origins_mm`` (N, 3) or (3,) along unit ``directions`` (N, 3); N may be 0."""
        if len(directions) == 0:  # because Dr.Jit ends the process when an empty array is evaluated
            none = np.zeros(0, dtype=np.int64)
            return Hits(none.astype(bool), np.zeros((0, 3)), np.zeros((0, 3)), none, none)
        import drjit as dr
        import mitsuba as mi

        origins = np.broadcast_to(origins_mm, directions.shape)
        # Rays start near the meshes, because single precision at a metre's distance would cost a tenth of a micrometre
        # per millimetre.
        centre = self._vertices.mean(axis=0)
        radius = float(np.linalg.norm(self._vertices - centre, axis=1).max()) + 1.0
        skip = np.maximum(0.0, ((centre - origins) * directions).sum(axis=1) - radius)
        start = origins + skip[:, None] * directions
        ray = mi.Ray3f(
            mi.Point3f(start.T.astype(np.float32)), mi.Vector3f(np.ascontiguousarray(directions.T, dtype=np.float32))
        )
        found = self._scene.ray_intersect_preliminary(ray, coherent=False)
        dr.eval(found.t, found.prim_index)
        distance, face = np.array(found.t, dtype=np.float64), np.array(found.prim_index, dtype=np.int64)
        hit = np.isfinite(distance)
        face = np.where(hit, face, 0)
        corners = self._vertices[self._faces[face]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        mesh = np.where(hit, np.searchsorted(self._first_face, face, side="right") - 1, -1)
        points = start + np.where(hit, distance, 0.0)[:, None] * directions
        return Hits(hit, points, normals, mesh, face - self._first_face[np.maximum(mesh, 0)])


def pixel_rays(
    camera: Camera, offset: tuple[float, float] = (0.5, 0.5)
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin (3,) and directions (H * W, 3) of rays through every pixel, row by row, at an offset inside the pixel."""
    width, height = camera.size
    x, y = np.meshgrid(np.arange(width) + offset[0], np.arange(height) + offset[1])
    return camera.rays(x.reshape(-1), y.reshape(-1))
