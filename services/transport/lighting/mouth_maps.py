"""Light maps of scenes with several surfaces. Each map holds the first object that a light's ray enters, and how far
the ray may be followed inside it.

An object is a tooth with its dentin, the gums, or the wall. Behind any other surface a map is not certain, and the
shadow ray alone decides. In front of all surfaces a map is certain too: a vertex there, on a wall, sees the light.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from services.transport.boundary.model import Boundary
from services.transport.lighting.light_maps import LightMaps, LightView, MapCell, MapRay
from services.transport.scene.geometry import Hit
from services.transport.scene.mesh_geometry import MeshGeometry

FIRST_SOLID = 31
"""Bits of ``events`` that hold one more than the first object's number, or 0 while there is none."""
DENTIN_ENTERED, DENTIN_LEFT = 32, 64
"""Bits of ``events`` that say whether the ray has entered and left that object's dentin."""

WALL_TEXELS = 2.0
"""Largest depth in texels of a vertex on the wall beyond the nearest corner of its cell."""


class MouthMaps(LightMaps):
    """One depth map per light for a scene of several teeth, gums or a wall."""

    WORDS = 3
    MAX_BYTES = 2**26

    def trace(self, geometry: MeshGeometry, boundary: Boundary) -> None:
        """Compute the maps for the present surfaces."""
        self._geometry = geometry
        super().trace(geometry, boundary)

    def _record_hit(self, ray: MapRay, geometry: MeshGeometry, hit: Hit, through: mi.Float) -> None:
        is_hit, entering = hit.valid, dr.dot(ray.direction, hit.normal) < 0
        solid = dr.select(hit.surface < geometry.teeth, hit.surface, hit.surface - geometry.teeth) + 1
        begins = is_hit & ((ray.events & FIRST_SOLID) == 0)
        dentin = is_hit & ~begins & ~hit.outer & (solid == (ray.events & FIRST_SOLID))
        enters = dentin & entering & ((ray.events & DENTIN_ENTERED) == 0)
        leaves = dentin & ~entering & ((ray.events & (DENTIN_ENTERED | DENTIN_LEFT)) == DENTIN_ENTERED)
        ends = is_hit & dr.select(begins, hit.opaque | ~entering, ~enters & ~leaves)

        ray.events |= (
            dr.select(begins, solid, 0)
            | dr.select(enters, mi.UInt32(DENTIN_ENTERED), 0)
            | dr.select(leaves, mi.UInt32(DENTIN_LEFT), 0)
        )
        ray.entry = dr.select(begins, ray.travelled, ray.entry)
        ray.surface = dr.select(begins, through, ray.surface)
        ray.dentin_entry = dr.select(enters, ray.travelled, ray.dentin_entry)
        # Until the ray leaves it, all the rest of the way counts as dentin.
        ray.dentin_exit = dr.select(enters, self._half_depth_mm, dr.select(leaves, ray.travelled, ray.dentin_exit))
        ray.limit = dr.select(ends, ray.travelled, ray.limit)
        ray.alive &= is_hit & ~ends

    def _store(self, ray: MapRay) -> None:
        first = ray.events & FIRST_SOLID
        solids = range(1, self._geometry.teeth + 2)
        kinds = tuple(
            number | dentin for number in solids for dentin in (0, DENTIN_ENTERED, DENTIN_ENTERED | DENTIN_LEFT)
        )
        entry = dr.select(first == 0, self._half_depth_mm, ray.entry)
        limit = mi.UInt32(self._depth_code(ray.limit)) | (first << 16)
        self._pack([entry, ray.dentin_entry, ray.dentin_exit], ray.surface, ray.events, kinds, (limit,))

    def _view(self, cell: MapCell, enclosure: mi.UInt32) -> LightView:
        halves = ((0, 0), (0, 16), (1, 0), (2, 0))
        entry, dentin_entry, dentin_exit, limit = (
            dr.fma(cell.interpolated(*half), self._depth_step, -self._half_depth_mm) for half in halves
        )
        solid = self._geometry.inside(enclosure)
        outside = solid > self._geometry.teeth
        followed = (
            ((cell.corners[0][1] & 0x10000) != 0) & ((cell.corners[0][2] >> 16) == solid + 1) & (cell.depth < limit)
        )
        nearest = cell.corners[0][0] & 0xFFFF
        for corner in cell.corners[1:]:
            nearest = dr.minimum(nearest, corner[0] & 0xFFFF)
        # For a vertex on the wall the first object is the wall itself, as far as the grid can resolve.
        free = outside & (
            cell.depth < dr.fma(mi.Float(nearest), self._depth_step, -self._half_depth_mm) + WALL_TEXELS * self.texel_mm
        )

        dentin_mm = dr.maximum(dr.minimum(cell.depth, dentin_exit) - dentin_entry, 0)
        enamel_mm = dr.maximum(cell.depth - entry - dentin_mm, 0)
        lengths_mm = [dr.select(outside, 0, enamel_mm), dr.select(outside, 0, dentin_mm)]
        numbers = self._geometry.numbers
        medium = dr.select(outside, mi.UInt32(1), self._geometry.outer_medium(solid))
        media = [medium, dr.select(solid < self._geometry.teeth, medium + 1, mi.UInt32(1))]
        surface = dr.select(outside, 1, cell.interpolated(1, 16) * (1 / 65535))
        certain = cell.inside & (followed | free)
        return LightView(
            cell.direction,
            cell.falloff,
            tuple(media[: 1 + numbers.dentin]),
            tuple(lengths_mm[: 1 + numbers.dentin]),
            surface,
            certain,
        )
