"""Which lights reach which triangles of the outer faces, found once for a scene: most triangles are lit or dark as a
whole.
"""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.boundary.model import Boundary
from services.transport.lighting.light_maps import LightView, aligned
from services.transport.scene.mesh_geometry import MeshGeometry

CORNER_SHARE = 0.9
"""Share of the way from a triangle's middle to its corners at which it is tested, beside its middle."""
DARK, MIXED, LIT = 0, 1, 2


class LitFaces:
    """A table of lights by triangles; it stands in for light maps where light bends at the face."""

    def __init__(
        self,
        positions_mm: NDArray[np.float64],
        intensities: NDArray[np.float64],
        outer_mm: NDArray[np.float64],  # noqa: ARG002 - maps need the scene's extent
    ) -> None:
        self.count, self.faces = len(positions_mm), 0
        columns = np.concatenate([positions_mm, intensities[:, None]], axis=1)
        self._lights = aligned(mi.Float(columns.astype(np.float32).reshape(-1)))
        self._table = mi.UInt32(0)

    def subset(self, chosen: list[int]) -> LitFaces:
        """The table of the ``chosen`` lights."""
        part = copy(self)
        part.restrict_to(chosen)
        return part

    def restrict_to(self, chosen: list[int]) -> None:
        """Discard the rows of all other lights."""
        self._lights = aligned(mi.Float(np.array(self._lights).reshape(self.count, 4)[chosen].reshape(-1)))
        self._table = mi.UInt32(np.array(self._table).reshape(self.count, self.faces)[chosen].reshape(-1))
        self.count = len(chosen)
        dr.eval(self._table)

    def trace(self, geometry: MeshGeometry, boundary: Boundary) -> None:  # noqa: ARG002 - maps need the boundary
        """Compute the table for the present surfaces, by four rays for each triangle and light."""
        self.faces = geometry.fixed_faces
        corners = geometry.fixed_corners_mm()
        middle = corners.mean(axis=1, keepdims=True)
        points = np.concatenate([middle, middle + CORNER_SHARE * (corners - middle)], axis=1)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        points += normals[:, None] * geometry.epsilon
        starts = mi.Point3f(np.ascontiguousarray(points.reshape(-1, 3).T, dtype=np.float32))
        lights = np.array(self._lights).reshape(self.count, 4)[:, :3]
        rows = []
        for light in lights:
            direction = dr.normalize(mi.Point3f(*light.tolist()) - starts)
            blocked = geometry.scene.ray_test(mi.Ray3f(starts, mi.Vector3f(direction)), coherent=False)
            dr.eval(blocked)
            dr.sync_thread()
            seen = (~np.array(blocked)).reshape(-1, 4).sum(axis=1)
            kinds = np.where(seen == 4, LIT, np.where(seen == 0, DARK, MIXED))
            # The wall of a mouth is open and seen from both sides.
            kinds[geometry.wall_faces] = MIXED
            rows.append(kinds)
        self._table = mi.UInt32(np.concatenate(rows).astype(np.uint32))
        dr.eval(self._table)

    def look_up(self, light: mi.UInt32, point: mi.Point3f, primitive: mi.UInt32, active: mi.Bool) -> LightView:
        """The light as seen from a point of a triangle; not certain where the triangle is lit in part."""
        found = dr.gather(mi.Vector4f, self._lights, light, active)
        towards = mi.Vector3f(found.x, found.y, found.z) - mi.Vector3f(point)
        inverse = dr.rsqrt(dr.squared_norm(towards))
        kind = dr.gather(mi.UInt32, self._table, light * self.faces + primitive, active)
        return LightView(
            towards * inverse,
            found.w * dr.square(inverse),
            (),
            (),
            dr.select(kind == LIT, mi.Float(1), 0),
            active & (kind != MIXED),
        )
