"""Teeth, gums and the wall of the mouth as triangles, and the media between them.

All surfaces are one mesh. A surface's number is k for the outer surface of tooth k of T, neighbours included, T + k for
its dentin, 2T for gums and 2T + 1 for the wall. A lane's *enclosure* holds bit n while it is inside the solid that
surface n bounds, so solids may overlap. Code for features that a scene lacks is absent from its kernels.
"""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.scans.patches import areas_mm2
from services.core.geometry import Mesh
from services.transport.optics.parameters import Stain
from services.transport.scene.clearance import Clearance
from services.transport.scene.geometry import RAY_EPSILON, Hit
from services.transport.scene.mitsuba_mesh import move_vertices, new_mesh
from services.transport.scene.names import media_numbers
from services.transport.scene.nearest_face import HIDDEN_MM, NearestFace, nearest_face_of
from services.transport.scene.nesting import require_nested
from services.transport.scene.recipe import SceneRecipe
from services.transport.scene.stain_textures import StainTextures

Shapes = tuple[tuple[float, ...], ...]
"""Blend weights of each tooth's dentin."""


class MeshGeometry:
    """The surfaces of one scene, with the dentin at its present shape."""

    def __init__(self, recipe: SceneRecipe) -> None:
        self.recipe = recipe
        self.teeth = len(recipe.all_teeth)
        dentins = [tooth.dentin for tooth in recipe.all_teeth]
        self.numbers = media_numbers(recipe)
        self.single = self.teeth == 1 and recipe.gums is None and recipe.cavity is None
        self.opaque = recipe.cavity is not None
        self.modes_of = tuple(0 if dentin is None else len(dentin.modes_mm) for dentin in dentins)
        self.epsilon = RAY_EPSILON * (1 + float(np.abs(recipe.vertices_mm()).max()))
        for tooth in recipe.all_teeth:
            if tooth.dentin is not None:
                require_nested(tooth.outer, tooth.dentin.base, 2 * self.epsilon)

        # Surfaces that never move come first.
        fixed = {k: tooth.outer for k, tooth in enumerate(recipe.all_teeth)}
        fixed |= {2 * self.teeth + k: mesh for k, mesh in enumerate((recipe.gums, recipe.cavity)) if mesh is not None}
        self._dentins: dict[int, DentinShape] = {k: dentin for k, dentin in enumerate(dentins) if dentin is not None}
        meshes = [*fixed.values(), *(dentin.base for dentin in self._dentins.values())]
        first = np.cumsum([0] + [len(mesh.vertices_mm) for mesh in meshes])
        self._faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, first, strict=False)]).astype(
            np.uint32
        )
        self._fixed_mm = np.concatenate([mesh.vertices_mm for mesh in fixed.values()])
        self.fixed_faces = sum(len(mesh.faces) for mesh in fixed.values())
        self.wall_faces = slice(self.fixed_faces - (len(recipe.cavity.faces) if recipe.cavity else 0), self.fixed_faces)
        numbers = [*fixed, *(self.teeth + k for k in self._dentins)]
        self._surface = mi.UInt32(np.repeat(numbers, [len(mesh.faces) for mesh in meshes]).astype(np.uint32))

        solids_mm = np.concatenate(
            [
                mesh.vertices_mm
                for mesh in (*(tooth.outer for tooth in recipe.all_teeth), *([recipe.gums] if recipe.gums else []))
            ]
        )
        self._clearance = Clearance(self._fixed_mm, self._faces[: self.fixed_faces].astype(np.int32), solids_mm)
        self.textures: StainTextures | None = None
        self._stains: tuple[Stain | None, ...] = (None,) * self.teeth
        self._shapes: Shapes | None = None
        self.reshape(tuple((0.0,) * modes for modes in self.modes_of))
        self._displacements = self._displacement_tables()

    def reshape(self, shapes: Shapes) -> bool:
        """Move the dentin surfaces to these blend weights; returns whether any changed."""
        if shapes == self._shapes:
            return False
        moved = [dentin.vertices_mm(shapes[k]) for k, dentin in self._dentins.items()]
        points = np.concatenate([self._fixed_mm, *moved])
        if moved:
            self._clearance.move_inner(
                [
                    Mesh(vertices, dentin.base.faces)
                    for vertices, dentin in zip(moved, self._dentins.values(), strict=True)
                ]
            )
        if self._shapes is None:
            mesh = new_mesh("teeth", points, self._faces)
            self.scene = mi.load_dict({"type": "scene", "teeth": mesh}, optimize=False)
            self._parameters = mi.traverse(self.scene)
        else:
            move_vertices(self._parameters, "teeth", points)
        corners = points[self._faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = mi.Float(
            np.ascontiguousarray((normals / np.maximum(lengths, 1e-30)).reshape(-1), dtype=np.float32)
        )
        dr.eval(self._normals)
        changed, self._shapes = self._shapes is not None, shapes
        return changed

    @property
    def stained(self) -> bool:
        """Whether any tooth has stains."""
        return self.textures is not None

    def restain(self, stains: tuple[Stain | None, ...]) -> bool:
        """Put these textures on the teeth; returns whether any changed."""
        if all(map(_is_same_stain, stains, self._stains)):
            return False
        self._stains, self.textures = stains, None
        if any(stain is not None for stain in stains):
            teeth = self.recipe.all_teeth
            corners = [
                np.zeros((len(tooth.outer.faces), 3, 2)) if tooth.stain_uv is None else tooth.stain_uv
                for tooth in teeth
            ]
            self.textures = StainTextures(corners, stains)
        return True

    def stain(self, hit: Hit, active: mi.Bool) -> mi.Float:
        """Transmittance of the stains where an outer face is crossed; 1 in lanes that are not active."""
        assert self.textures is not None
        return self.textures.transmittance(hit, active)

    def on_stain(self, hit: Hit, before: mi.UInt32, after: mi.UInt32) -> mi.Bool:
        """Whether a ray crosses a tooth's outer face that does not lie hidden within another tooth."""
        if self.single:
            return hit.valid & hit.outer
        return hit.valid & (hit.surface < self.teeth) & (self.inside(before) != self.inside(after))

    def first_dentin_face(self, tooth: int) -> int:
        """Number of the first triangle of a tooth's dentin."""
        return self.fixed_faces + sum(len(dentin.base.faces) for k, dentin in self._dentins.items() if k < tooth)

    def dentin_areas_mm2(self, tooth: int) -> NDArray[np.float64]:
        """Areas of the triangles of a tooth's dentin at its present shape."""
        assert self._shapes is not None
        dentin = self._dentins[tooth]
        return areas_mm2(Mesh(dentin.vertices_mm(self._shapes[tooth]), dentin.base.faces))

    def _displacement_tables(self) -> list[mi.Float]:
        """B_m - B0 at the corners of every dentin face, a table per mode; zero where a tooth has fewer modes."""
        tables = []
        for mode in range(max(self.modes_of, default=0)):
            parts = [
                (dentin.modes_mm[mode] if mode < len(dentin.modes_mm) else np.zeros_like(dentin.base.vertices_mm))[
                    dentin.base.faces
                ]
                for dentin in self._dentins.values()
            ]
            tables.append(mi.Float(np.ascontiguousarray(np.concatenate(parts).reshape(-1), dtype=np.float32)))
        return tables

    def intersect(self, origin: mi.Point3f, direction: mi.Vector3f, enclosure: mi.UInt32, active: mi.Bool) -> Hit:  # noqa: ARG002 - slabs need the enclosure
        """Next surface along a ray, by ray tracing."""
        ray = mi.Ray3f(origin, direction)
        found = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        valid = active & found.is_valid()
        normal = dr.gather(mi.Normal3f, self._normals, found.prim_index, valid)
        outer = found.prim_index < self.fixed_faces if self._dentins else mi.Bool(True)
        surface = mi.UInt32(0) if self.single else dr.gather(mi.UInt32, self._surface, found.prim_index, valid)
        opaque = valid & (surface == 2 * self.teeth + 1) if self.opaque else mi.Bool(False)
        return Hit(
            dr.select(valid, found.t, dr.inf), valid, normal, outer, opaque, surface, found.prim_index, found.prim_uv
        )

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Distance in mm within which no surface lies; not positive where that is not known."""
        return self._clearance(point, active)

    def nearest_face(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """Outward normal of the nearest part of the first tooth's outer face, and the depth below it in mm."""
        return self._nearest_face(point, active)

    def is_below_air(self, enclosure: mi.UInt32, depth_mm: mi.Float) -> mi.Bool:
        """Whether a place lies in the first tooth, and air before its nearest face, by the depth that it has there."""
        return mi.Bool(True) if self.single else (self.inside(enclosure) == 0) & (depth_mm < HIDDEN_MM)

    @cached_property
    def _nearest_face(self) -> NearestFace:
        outer = self.recipe.teeth[0].outer
        return nearest_face_of(outer) if self.single else nearest_face_of(outer, self._fixed_mm, self._are_hidden)

    def _are_hidden(self, points_mm: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.bool_]:
        # A ray out of another solid meets that one's surface from behind; the wall of the mouth bounds none.
        starts = np.ascontiguousarray((points_mm + 2 * self.epsilon * normals).T, dtype=np.float32)
        direction = mi.Vector3f(np.ascontiguousarray(normals.T, dtype=np.float32))
        hit = self.intersect(mi.Point3f(starts), direction, mi.UInt32(0), mi.Bool(True))
        return np.array(hit.valid & ~hit.opaque & (dr.dot(hit.normal, direction) > 0))

    def inside(self, enclosure: mi.UInt32) -> mi.UInt32:
        """Number of the tooth whose tissue fills an enclosure; the number of teeth for gums, and one more outside of
        all solids.
        """
        within = enclosure & (2**self.teeth - 1)
        if self._dentins:
            dentin = (enclosure >> self.teeth) & (2**self.teeth - 1)
            within = dr.select(dentin != 0, dentin, within)
        return dr.select(
            within != 0,
            dr.tzcnt(within),
            dr.select((enclosure >> (2 * self.teeth)) != 0, mi.UInt32(self.teeth), mi.UInt32(self.teeth + 1)),
        )

    def medium(self, enclosure: mi.UInt32) -> mi.UInt32:
        """Medium of an enclosure: dentin over enamel over gums over air, whatever surfaces overlap."""
        if self.single:
            inside_outer = enclosure & 1
            return dr.select((enclosure & 2) != 0, mi.UInt32(2), inside_outer) if self._dentins else inside_outer
        tooth, numbers = self.inside(enclosure), self.numbers
        enamel = self.outer_medium(tooth)
        in_dentin = ((enclosure >> self.teeth) & (2**self.teeth - 1)) != 0
        of_tooth = dr.select(in_dentin, enamel + 1, enamel) if self._dentins else enamel
        return dr.select(
            tooth < self.teeth, of_tooth, dr.select(tooth == self.teeth, mi.UInt32(numbers.of_gums), mi.UInt32(0))
        )

    def outer_medium(self, solid: mi.UInt32) -> mi.UInt32:
        """Medium of a tooth's enamel, or of the gums, by the number that ``inside`` gives. That of the dentin, if the
        scene has any, is one more than the enamel's.
        """
        if self.recipe.neighbours:
            return dr.select(solid < self.teeth, mi.UInt32(1), mi.UInt32(self.numbers.of_gums))
        return solid * (1 + self.numbers.dentin) + 1

    def beyond(self, enclosure: mi.UInt32, direction: mi.Vector3f, hit: Hit) -> mi.UInt32:
        """Place after a hit. Entering sets the surface's bit and leaving clears it, so the next hit corrects a missed
        one.
        """
        bit = dr.select(hit.outer, mi.UInt32(1), mi.UInt32(2)) if self.single else mi.UInt32(1) << hit.surface
        return dr.select(dr.dot(direction, hit.normal) < 0, enclosure | bit, enclosure & ~bit)

    def contrast(self, ior: mi.Float, before: mi.UInt32, after: mi.UInt32) -> mi.Float:
        """Ratio, at least 1, of the indices of refraction of the media at two places."""
        if self.single:
            return ior
        first, second = self.index(ior, before), self.index(ior, after)
        return dr.maximum(first, second) / dr.minimum(first, second)

    def index(self, ior: mi.Float, enclosure: mi.UInt32) -> mi.Float:
        """Index of refraction at a place."""
        tooth = self.inside(enclosure)
        return dr.select(tooth < self.teeth, ior, dr.select(tooth == self.teeth, self.recipe.gums_ior, 1.0))

    def advance(self, origin: mi.Point3f, direction: mi.Vector3f, hit: Hit, through: mi.Bool) -> mi.Point3f:
        """The hit point, offset along the normal to either side as Mitsuba does."""
        offset = dr.mulsign(dr.select(through, self.epsilon, -self.epsilon), dr.dot(direction, hit.normal))
        return dr.fma(direction, hit.distance, origin) + hit.normal * offset

    def outside(self, point: mi.Point3f, hit: Hit, inside: mi.Bool) -> mi.Point3f:
        """The point that ``advance`` gave, moved to the outer side of the face where it is on the ``inside``."""
        return mi.Point3f(point + mi.Vector3f(hit.normal) * dr.select(inside, mi.Float(2 * self.epsilon), 0))

    def fixed_corners_mm(self) -> NDArray[np.float64]:
        """Corners (F, 3, 3) of the triangles of all surfaces that never move."""
        return np.asarray(self._fixed_mm[self._faces[: self.fixed_faces]])

    def velocity(self, hit: Hit, tooth: int, active: mi.Bool) -> list[mi.Float]:
        """Normal speed n . (B_m - B0) at the hit for each shape mode m, interpolated over its triangle; zero except on
        the dentin of the one tooth.
        """
        active = active & ~hit.outer & hit.valid
        if not self.single:
            active &= hit.surface == self.teeth + tooth
        face = (hit.primitive - self.fixed_faces) * 3
        weights = (1 - hit.uv.x - hit.uv.y, hit.uv.x, hit.uv.y)
        speeds = []
        for table in self._displacements[: self.modes_of[tooth]]:
            displacement = mi.Vector3f(0)
            for corner, weight in enumerate(weights):
                displacement += weight * dr.gather(mi.Vector3f, table, face + corner, active)
            speeds.append(dr.select(active, dr.dot(hit.normal, displacement), 0))
        return speeds


def _is_same_stain(one: Stain | None, other: Stain | None) -> bool:
    # Compare by value, because a stain that travelled between processes is another object.
    return one is other or (
        one is not None and other is not None and np.array_equal(one.transmittance, other.transmittance)
    )
