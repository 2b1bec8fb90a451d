"""Where media lie. The walk asks two questions of a geometry: what do I hit next, and which medium is behind it.

A geometry's *place* is a small integer per lane that says where the lane is: for meshes the set of surfaces it is inside
of, for slabs the number of the layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.fit.transport.clearance import Clearance
from services.fit.transport.nesting import require_nested
from services.fit.transport.recipe import SceneRecipe

ENAMEL, DENTIN = 1, 2
RAY_EPSILON = 8.9e-5
"""Mitsuba's relative ray offset in single precision, 1500 ulp."""


@dataclass
class Hit:
    """The next surface along a ray; ``distance`` is infinite where there is none."""

    distance: mi.Float
    valid: mi.Bool
    normal: mi.Normal3f
    outer: mi.Bool
    """Whether the surface bounds the whole object, so that beyond it is empty space."""
    primitive: mi.UInt32
    uv: mi.Point2f


class Geometry(Protocol):
    """Nested media."""

    modes: int
    """Shape modes of the inner border."""
    epsilon: float
    """Ray offset, mm."""

    def intersect(self, origin: mi.Point3f, direction: mi.Vector3f, place: mi.UInt32, active: mi.Bool) -> Hit:
        """Next surface."""

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Distance in mm within which no surface lies; 0 where that is not known."""

    def medium(self, place: mi.UInt32) -> mi.UInt32:
        """Index of the medium, 0 for empty space."""

    def beyond(self, place: mi.UInt32, direction: mi.Vector3f, hit: Hit) -> mi.UInt32:
        """Place after crossing the surface."""

    def advance(self, origin: mi.Point3f, direction: mi.Vector3f, hit: Hit, through: mi.Bool) -> mi.Point3f:
        """The hit point, offset to just beyond the surface where ``through``, else to just before it."""

    def velocity(self, hit: Hit, active: mi.Bool) -> list[mi.Float]:
        """Normal speed n . dx/dc_m of the hit border point for each shape mode m."""


class MeshGeometry:
    """A tooth: one triangle mesh that holds the outer surface and, nested in it, the dentin's."""

    def __init__(self, recipe: SceneRecipe) -> None:
        self.recipe = recipe
        self.shape = recipe.dentin
        self.outer_faces = len(recipe.outer.faces)
        self._outer_vertices = len(recipe.outer.vertices_mm)
        self.modes = 0 if self.shape is None else len(self.shape.modes_mm)
        self.epsilon = RAY_EPSILON * (1 + float(np.abs(recipe.outer.vertices_mm).max()))
        if self.shape is not None:
            require_nested(recipe.outer, self.shape.base, 2 * self.epsilon)
        faces = [recipe.outer.faces]
        if self.shape is not None:
            faces.append(self.shape.base.faces + self._outer_vertices)
        self._faces = np.concatenate(faces).astype(np.uint32)
        self._current: tuple[float, ...] | None = None
        self._clearance = Clearance(recipe.outer.vertices_mm, recipe.outer.faces)
        self._build((0.0,) * self.modes)
        if self.shape is not None:
            self._mode_tables = [mi.Float(np.ascontiguousarray(mode[self.shape.base.faces].reshape(-1), dtype=np.float32)) for mode in self.shape.modes_mm]

    def _build(self, shape: tuple[float, ...]) -> None:
        vertices = [self.recipe.outer.vertices_mm]
        if self.shape is not None:
            vertices.append(self.shape.vertices_mm(shape))
            self._clearance.move_inner(vertices[1], self.shape.base.faces)
        points = np.concatenate(vertices)
        if self._current is None:
            mesh = mi.Mesh("tooth", len(points), len(self._faces))
            self._parameters = mi.traverse(mesh)
            self._parameters["faces"] = mi.UInt32(self._faces.reshape(-1))
            self._parameters["vertex_positions"] = mi.Float(points.reshape(-1).astype(np.float32))
            self._parameters.update()
            self.scene = mi.load_dict({"type": "scene", "tooth": mesh}, optimize=False)
            self._parameters = mi.traverse(self.scene)
        else:
            self._parameters["tooth.vertex_positions"] = mi.Float(points.reshape(-1).astype(np.float32))
            self._parameters.update()
        corners = points[self._faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = mi.Float(np.ascontiguousarray((normals / np.maximum(lengths, 1e-30)).reshape(-1), dtype=np.float32))
        dr.eval(self._normals)
        self._current = shape

    def reshape(self, shape: tuple[float, ...]) -> bool:
        """Move the dentin surface to blend weights ``shape``; returns whether they changed."""
        changed = self.modes > 0 and tuple(shape) != self._current
        if changed:
            self._build(tuple(shape))
        return changed

    def dentin_areas_mm2(self) -> NDArray[np.float64]:
        """Areas of the dentin's triangles at the present shape."""
        assert self.shape is not None
        assert self._current is not None
        corners = self.shape.vertices_mm(self._current)[self.shape.base.faces]
        return np.asarray(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2)

    def intersect(self, origin: mi.Point3f, direction: mi.Vector3f, place: mi.UInt32, active: mi.Bool) -> Hit:  # noqa: ARG002 - slabs need the place
        """Next surface, by ray tracing."""
        ray = mi.Ray3f(origin, direction)
        found = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        valid = active & found.is_valid()
        normal = dr.gather(mi.Normal3f, self._normals, found.prim_index, valid)
        outer = mi.Bool(True) if self.shape is None else found.prim_index < self.outer_faces
        return Hit(dr.select(valid, found.t, dr.inf), valid, normal, outer, found.prim_index, found.prim_uv)

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Distance within which no surface lies."""
        return self._clearance(point, active)

    def medium(self, place: mi.UInt32) -> mi.UInt32:
        """Dentin over enamel over air, whatever surfaces overlap."""
        inside_outer = place & 1
        return inside_outer if self.shape is None else dr.select((place & 2) != 0, DENTIN, inside_outer)

    def beyond(self, place: mi.UInt32, direction: mi.Vector3f, hit: Hit) -> mi.UInt32:
        """Entering sets the surface's bit and leaving clears it, so a missed hit heals at the next."""
        bit = dr.select(hit.outer, mi.UInt32(1), mi.UInt32(2))
        return dr.select(dr.dot(direction, hit.normal) < 0, place | bit, place & ~bit)

    def advance(self, origin: mi.Point3f, direction: mi.Vector3f, hit: Hit, through: mi.Bool) -> mi.Point3f:
        """Offset along the normal as Mitsuba does."""
        offset = dr.mulsign(dr.select(through, self.epsilon, -self.epsilon), dr.dot(direction, hit.normal))
        return dr.fma(direction, hit.distance, origin) + hit.normal * offset

    def velocity(self, hit: Hit, active: mi.Bool) -> list[mi.Float]:
        """Normal speed n . (B_m - B0) at the hit, interpolated over its triangle; zero on the outer surface."""
        active = active & ~hit.outer & hit.valid
        face = (hit.primitive - self.outer_faces) * 3
        weights = (1 - hit.uv.x - hit.uv.y, hit.uv.x, hit.uv.y)
        speeds = []
        for table in self._mode_tables:
            displacement = mi.Vector3f(0)
            for corner, weight in enumerate(weights):
                displacement += weight * dr.gather(mi.Vector3f, table, face + corner, active)
            speeds.append(dr.select(active, dr.dot(hit.normal, displacement), 0))
        return speeds


class SlabGeometry:
    """Plane-parallel layers, laterally infinite; the lit face at z = 0, +z into the slab. Place = layer, 1..N."""

    epsilon = 0.0

    def __init__(self, thicknesses_mm: Sequence[float | NDArray[np.float64]], *, moving_border: bool) -> None:
        """Take each layer's thickness once for all lanes, or as an array of one per lane."""
        depths: list[float | NDArray[np.float64]] = [0.0]
        for thickness in thicknesses_mm:
            depths.append(depths[-1] + thickness)
        self.layers = len(thicknesses_mm)
        self._planes = [mi.Float(depth.astype(np.float32)) if isinstance(depth, np.ndarray) else dr.opaque(mi.Float, depth) for depth in depths]
        self.modes = int(moving_border)

    def intersect(self, origin: mi.Point3f, direction: mi.Vector3f, place: mi.UInt32, active: mi.Bool) -> Hit:
        """Next plane, exactly: the layer is known, so no tolerance is needed."""
        down = direction.z > 0
        target = dr.select(down, self._planes[1], self._planes[0])
        for layer in range(2, self.layers + 1):
            target = dr.select(place == layer, dr.select(down, self._planes[layer], self._planes[layer - 1]), target)
        distance = dr.maximum((target - origin.z) / direction.z, 0)
        distance = dr.select(active & (direction.z != 0), distance, dr.inf)
        outer = dr.select(down, place == self.layers, place == 1)
        return Hit(distance, active & dr.isfinite(distance), mi.Normal3f(0, 0, 1), outer, place, mi.Point2f(0))

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:  # noqa: ARG002 - planes are as cheap to hit
        """Not used: hitting a plane costs as little."""
        return mi.Float(0)

    def medium(self, place: mi.UInt32) -> mi.UInt32:
        """Layer number; both outsides are empty."""
        return dr.select(place > self.layers, 0, place)

    def beyond(self, place: mi.UInt32, direction: mi.Vector3f, hit: Hit) -> mi.UInt32:  # noqa: ARG002 - meshes need the hit
        """Neighbouring layer."""
        return dr.select(direction.z > 0, place + 1, place - 1)

    def advance(self, origin: mi.Point3f, direction: mi.Vector3f, hit: Hit, through: mi.Bool) -> mi.Point3f:  # noqa: ARG002 - meshes need it
        """The plane itself: the layer number says which side."""
        return dr.fma(direction, dr.select(hit.valid, hit.distance, 0), origin)

    def velocity(self, hit: Hit, active: mi.Bool) -> list[mi.Float]:
        """The first inner border moves along +z."""
        return [dr.select(active & hit.valid & ~hit.outer, mi.Float(1), 0)]
