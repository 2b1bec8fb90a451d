"""Depth maps as seen from every light: the media between a scattering vertex and the light, looked up instead of ray
traced.

One map per light holds, on a grid of directions, where the light's ray enters the outer surface and where it enters and
leaves the dentin. Between grid points depths are interpolated, so that the optical depth from any vertex to any light
costs one look-up. It is an estimate; the walk corrects it by exact shadow rays, few where the map is smooth and more
where it is uncertain: at silhouettes, and where a ray meets a surface more often than once in and once out (translucent
shadow maps, Dachsbacher and Stamminger 2003, here as a control variate).
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.boundary.model import Boundary
from services.transport.scene.geometry import DENTIN, ENAMEL, Hit
from services.transport.scene.media import Media

if TYPE_CHECKING:
    from services.transport.scene.mesh_geometry import MeshGeometry

TEXEL_MM = 0.15
"""Spacing of a map's grid at the tooth, mm."""
MARGIN_MM = 1.0
"""Distance in mm from the sphere around the scene to the start of a map's rays."""
DARK_DEPTH = 40.0
"""Optical depth beyond which a connection is dark: exp(-40) is below float32 resolution of any sum that it could
join."""
WIDEST = 3.0
"""Largest half-width of a map, over the radius of the sphere around the scene."""


@dataclass
class LightView:
    """Media and light in the direction from a vertex to one light, according to a map."""

    direction: mi.Vector3f
    falloff: mi.Float
    """Intensity over squared distance."""
    media: tuple[int | mi.UInt32, ...]
    """Numbers of the media on the way to the light."""
    lengths_mm: tuple[mi.Float, ...]
    """Path length in mm through each of ``media``."""
    surface: mi.Float
    """Transmittance of the outer face."""
    certain: mi.Bool
    """Whether the map is certain; elsewhere the lengths are meaningless."""

    def lengths(self, media: tuple[int, ...]) -> list[mi.Float]:
        """Path length in mm inside each of ``media``."""
        found = []
        for medium in media:
            of_this = [
                dr.select(number == medium, length, 0)
                for number, length in zip(self.media, self.lengths_mm, strict=True)
            ]
            found.append(sum(of_this, start=mi.Float(0)))
        return found

    def transmittance(self, media: Media) -> mi.Float:
        """Expected transmittance, 0 where the map is not certain."""
        depth = mi.Float(0)
        for number, length in zip(self.media, self.lengths_mm, strict=True):
            if not isinstance(number, int):
                depth = dr.fma(media.pick(media.sigma, number), length, depth)
            elif number <= media.count:
                depth = dr.fma(media.sigma[number - 1], length, depth)
        return dr.select(self.certain & (depth < DARK_DEPTH), self.surface * dr.exp(-depth), 0)


@dataclass
class MapRay:
    """A light's ray on its way through the scene, and the surfaces that it has met."""

    point: mi.Point3f
    direction: mi.Vector3f
    travelled: mi.Float
    """Distance in mm from the plane across the scene's centre, negative before it."""
    enclosure: mi.UInt32
    entry: mi.Float
    """Distance travelled to the entry into the outer surface, mm."""
    dentin_entry: mi.Float
    """Distance travelled to the entry into dentin, mm."""
    dentin_exit: mi.Float
    """Distance travelled to the exit from dentin, mm."""
    surface: mi.Float
    """Transmittance of the outer face."""
    events: mi.UInt32
    """Surfaces met so far, coded in bits."""
    limit: mi.Float
    """Distance travelled up to the surface behind which the map is not certain."""
    alive: mi.Bool


@dataclass
class MapCell:
    """Position of a vertex in a light's map: the four grid points around it, and the light itself."""

    direction: mi.Vector3f
    falloff: mi.Float
    depth: mi.Float
    """Depth of the vertex along the light's ray, mm."""
    corners: list[list[mi.UInt32]]
    """Table words of each grid point."""
    u: mi.Float
    """Fraction of a cell along a row of the grid."""
    v: mi.Float
    """Fraction of a cell across the rows."""
    inside: mi.Bool
    """Whether the vertex lies on the map."""

    def interpolated(self, word: int, shift: int) -> mi.Float:
        """Bilinear interpolation of the 16-bit number that starts at bit ``shift`` (0 or 16) of a table word."""
        values = [
            mi.Float((corner[word] >> shift) & 0xFFFF if shift == 0 else corner[word] >> shift)
            for corner in self.corners
        ]
        return dr.lerp(dr.lerp(*values[:2], self.u), dr.lerp(*values[2:], self.u), self.v)


class LightMaps:
    """One depth map per light of a single tooth, over a square of directions that holds all of it."""

    WORDS = 2
    """Number of 32-bit table words per grid point."""
    MAX_BYTES = 2**29
    """Largest size of all maps together; larger scenes under more lights have a coarser grid."""

    def __init__(
        self, positions_mm: NDArray[np.float64], intensities: NDArray[np.float64], outer_mm: NDArray[np.float64]
    ) -> None:
        centre = 0.5 * (outer_mm.min(axis=0) + outer_mm.max(axis=0))
        radius = float(np.linalg.norm(outer_mm - centre, axis=1).max())
        relative = positions_mm - centre
        distance = np.linalg.norm(relative, axis=1)

        # Half-width at which a map holds the whole sphere as seen from its light; outside the map of a very near light
        # nothing is certain.
        half_mm = float((radius / np.sqrt(np.maximum(1 - (radius / distance) ** 2, WIDEST**-2))).max())
        self.count = len(positions_mm)
        self.texel_mm = max(TEXEL_MM, 2 * half_mm / math.sqrt(self.MAX_BYTES / (4 * self.WORDS * self.count)))
        self.size = 2 * int(np.ceil(half_mm / self.texel_mm)) + 3

        helper = np.where(np.abs(relative[:, :1]) < 0.9 * distance[:, None], [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        right = np.cross(relative, helper)
        right *= (distance / np.linalg.norm(right, axis=1) / self.texel_mm)[:, None]
        self._half_depth_mm = float(radius + MARGIN_MM)
        self._centre = dr.opaque(mi.Vector3f, centre.tolist())
        columns = [-relative / distance[:, None], intensities[:, None], right, distance[:, None]]
        self._frames = aligned(mi.Float(np.concatenate(columns, axis=1).astype(np.float32).reshape(-1)))
        self._table = mi.UInt32(0)
        self._depth_step = 2 * self._half_depth_mm / 65535
        dr.eval(self._frames)

    def subset(self, chosen: list[int]) -> LightMaps:
        """The maps of the ``chosen`` lights."""
        maps = copy(self)
        maps.restrict_to(chosen)
        return maps

    def restrict_to(self, chosen: list[int]) -> None:
        """Discard the maps of all other lights."""
        self._frames = aligned(mi.Float(np.array(self._frames).reshape(self.count, -1)[chosen].reshape(-1)))
        self._table = mi.UInt32(np.array(self._table).reshape(self.count, -1)[chosen].reshape(-1))
        self.count = len(chosen)
        dr.eval(self._table)

    def trace(self, geometry: MeshGeometry, boundary: Boundary) -> None:
        """Compute the maps for the present surfaces."""
        lanes = self.count * self.size**2
        index = dr.arange(mi.UInt32, lanes)
        frame = self._frame(index // self.size**2)
        x = mi.Float(index % self.size) - self.size // 2
        y = mi.Float(index // self.size % self.size) - self.size // 2
        # Aim every ray at a grid point of the plane across the scene's centre, without the difference of two long
        # distances.
        across = (frame.right * x + frame.up * y) * dr.square(self.texel_mm / frame.distance)
        ray_length = dr.norm(frame.forward + across) * frame.distance
        direction = (frame.forward + across) * (frame.distance / ray_length)
        offset = across * frame.distance
        before = self._half_depth_mm + dr.squared_norm(offset) / (ray_length + frame.distance)
        start = mi.Point3f(self._centre + offset - direction * before)

        def step(ray: MapRay) -> tuple[MapRay]:
            hit = geometry.intersect(ray.point, ray.direction, ray.enclosure, ray.alive)
            behind = geometry.beyond(ray.enclosure, ray.direction, hit)
            ray.travelled += dr.select(hit.valid, hit.distance, 0)
            through = mi.Float(1)
            if not boundary.unaltered:
                through = boundary.straight(geometry, ray.direction, ray.enclosure, behind, hit)
            if geometry.stained:
                through *= geometry.stain(hit, ray.alive & geometry.on_stain(hit, ray.enclosure, behind))
            self._record_hit(ray, geometry, hit, through)
            ray.point = dr.select(hit.valid, geometry.advance(ray.point, ray.direction, hit, hit.valid), ray.point)
            ray.enclosure = dr.select(hit.valid, behind, ray.enclosure)
            return (ray,)

        ray = MapRay(
            start, direction, dr.full(mi.Float, -self._half_depth_mm, lanes), dr.zeros(mi.UInt32, lanes),
            dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes),
            dr.full(mi.Float, 1, lanes), dr.zeros(mi.UInt32, lanes), dr.full(mi.Float, -self._half_depth_mm, lanes),
            dr.full(mi.Bool, True, lanes),
        )  # fmt: skip
        (ray,) = dr.while_loop((ray,), lambda ray: ray.alive, step, label="light map")
        dr.eval(ray)
        dr.sync_thread()
        self._store(ray)

    def _record_hit(self, ray: MapRay, geometry: MeshGeometry, hit: Hit, through: mi.Float) -> None:  # noqa: ARG002 - scenes of several surfaces need it
        """Record a surface that a ray meets.

        Bits of ``events``: outer surface entered, dentin entered, dentin left, outer surface left; the last bit marks
        any other order.
        """
        entering, is_hit = dr.dot(ray.direction, hit.normal) < 0, hit.valid
        event = dr.select(
            hit.outer, dr.select(entering, mi.UInt32(1), mi.UInt32(8)), dr.select(entering, mi.UInt32(2), mi.UInt32(4))
        )
        # Every event must happen once, and those of the dentin inside the tooth.
        repeated = (ray.events & event) != 0
        unordered = ((event > 1) & ((ray.events & 1) == 0)) | ((ray.events & 8) != 0)
        ray.events |= dr.select(is_hit, event | dr.select(repeated | unordered, mi.UInt32(16), mi.UInt32(0)), 0)
        ray.entry = dr.select(is_hit & (event == 1), ray.travelled, ray.entry)
        ray.dentin_entry = dr.select(is_hit & (event == 2), ray.travelled, ray.dentin_entry)
        ray.dentin_exit = dr.select(is_hit & (event == 4), ray.travelled, ray.dentin_exit)
        ray.surface = dr.select(is_hit & (event == 1), through, ray.surface)
        ray.alive &= is_hit & ((ray.events & 16) == 0)

    def _store(self, ray: MapRay) -> None:
        self._pack([ray.entry, ray.dentin_entry, ray.dentin_exit], ray.surface, ray.events, (1 | 8, 1 | 2 | 4 | 8))

    def _pack(
        self,
        depths: list[mi.Float],
        surface: mi.Float,
        kind: mi.UInt32,
        certain_kinds: tuple[int, ...],
        more: tuple[mi.UInt32, ...] = (),
    ) -> None:
        """Store four numbers of 16 bits per grid point, so that all maps stay in the cache: three depths, and the outer
        face's transmittance with the cell's certainty in the lowest bit.

        A cell is certain where the rays of all its corners met the same surfaces, in one of the orders
        ``certain_kinds``, which the map can represent.
        """
        shape = (self.count, self.size, self.size)
        kinds = np.array(kind).reshape(shape)
        certain = np.zeros(shape, dtype=np.uint32)
        corners = [kinds[:, :-1, :-1], kinds[:, 1:, :-1], kinds[:, :-1, 1:], kinds[:, 1:, 1:]]
        certain[:, :-1, :-1] = np.logical_and.reduce([corner == corners[0] for corner in corners]) & np.isin(
            corners[0], certain_kinds
        )
        codes = [self._depth_code(depth).reshape(shape) for depth in depths]
        codes.append(
            np.rint(np.clip(np.array(surface, dtype=np.float64), 0, 1) * 65535).astype(np.uint32).reshape(shape)
            & ~np.uint32(1)
            | certain
        )
        words = [
            codes[0] | codes[1] << 16,
            codes[2] | codes[3] << 16,
            *(np.array(word).reshape(shape) for word in more),
        ]
        self._table = mi.UInt32(np.stack(words, axis=-1).reshape(-1))
        dr.eval(self._table)

    def _depth_code(self, depth: mi.Float) -> NDArray[np.uint32]:
        return np.clip(
            np.rint((np.array(depth, dtype=np.float64) + self._half_depth_mm) / self._depth_step), 0, 65535
        ).astype(np.uint32)

    @dataclass
    class _Frame:
        """Frame of a light that looks at the scene; ``right`` and ``up`` have the length of ``distance`` in texels."""

        intensity: mi.Float
        right: mi.Vector3f
        up: mi.Vector3f
        forward: mi.Vector3f
        distance: mi.Float

    def _frame(self, light: mi.UInt32) -> LightMaps._Frame:
        first, second = (dr.gather(mi.Vector4f, self._frames, light * 2 + k) for k in (0, 1))
        forward, right = mi.Vector3f(first.x, first.y, first.z), mi.Vector3f(second.x, second.y, second.z)
        return LightMaps._Frame(first.w, right, dr.cross(forward, right), forward, second.w)

    def look_up(self, light: mi.UInt32, point: mi.Point3f, enclosure: mi.UInt32, active: mi.Bool) -> LightView:
        """Media between ``point`` and a light, with the direction to that light."""
        frame, from_centre = self._frame(light), mi.Vector3f(point - self._centre)
        from_light = frame.forward * frame.distance + from_centre
        ahead = dr.dot(from_centre, frame.forward)
        squared = dr.squared_norm(from_light)
        inverse = dr.rsqrt(squared)
        # Depth of the vertex beyond the scene's centre, without the difference of two long distances.
        depth = dr.fma(2 * frame.distance, ahead, dr.squared_norm(from_centre)) / dr.fma(
            squared, inverse, frame.distance
        )

        # Interpolate between the four rays around the vertex.
        per_forward = dr.rcp(frame.distance + ahead)
        x = dr.fma(dr.dot(from_centre, frame.right), per_forward, self.size // 2)
        y = dr.fma(dr.dot(from_centre, frame.up), per_forward, self.size // 2)
        column, row = dr.floor(x), dr.floor(y)
        cell = (light * self.size + mi.UInt32(dr.maximum(row, 0))) * self.size + mi.UInt32(dr.maximum(column, 0))
        cell = dr.minimum(cell, self.count * self.size**2 - self.size - 2)
        inside = (per_forward > 0) & (dr.minimum(column, row) >= 0) & (dr.maximum(column, row) < self.size - 1)
        corners = [
            [dr.gather(mi.UInt32, self._table, self.WORDS * (cell + k) + word) for word in range(self.WORDS)]
            for k in (0, 1, self.size, self.size + 1)
        ]
        found = MapCell(
            -from_light * inverse,
            frame.intensity * dr.square(inverse),
            depth,
            corners,
            x - column,
            y - row,
            active & inside,
        )
        return self._view(found, enclosure)

    def _view(self, cell: MapCell, enclosure: mi.UInt32) -> LightView:  # noqa: ARG002 - scenes of several surfaces need the enclosure
        """Media and light according to a cell of the map."""
        entry, dentin_entry, dentin_exit = (
            dr.fma(cell.interpolated(*half), self._depth_step, -self._half_depth_mm)
            for half in ((0, 0), (0, 16), (1, 0))
        )
        dentin_mm = dr.maximum(dr.minimum(cell.depth, dentin_exit) - dentin_entry, 0)
        enamel_mm = dr.maximum(cell.depth - entry - dentin_mm, 0)
        certain = cell.inside & ((cell.corners[0][1] & 0x10000) != 0)
        return LightView(
            cell.direction,
            cell.falloff,
            (ENAMEL, DENTIN),
            (enamel_mm, dentin_mm),
            cell.interpolated(1, 16) * (1 / 65535),
            certain,
        )


def aligned(values: Any) -> Any:
    """A copy in Dr.Jit's own memory, because a NumPy buffer may lack the alignment that a gather of four numbers at
    once needs.

    A kernel that reads one number per lane is compiled for the alignment of its input, so with NumPy buffers it would
    be compiled again at random.
    """
    copy = values + dr.opaque(type(values), 0)
    dr.eval(copy)
    return copy
