"""Geometries: the regions that media fill. The walk asks a geometry for the next surface along a ray and for the medium
behind it.

A geometry's *enclosure* is a small integer per lane that encodes its position: for meshes (``mesh_geometry.py``) the
set of surfaces it is inside of, for slabs the number of the layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

ENAMEL, DENTIN = 1, 2
"""Numbers of the media of a single tooth."""
RAY_EPSILON = 1e-5
"""Offset of a ray that starts on a surface, over 1 + the largest coordinate: 170 roundings. The skipped distance
neither absorbs nor scatters, so the offset is nine times less than Mitsuba's own; of two million rays none met its
surface again at an offset thirty times less."""


@dataclass
class Hit:
    """The next surface along a ray; ``distance`` is infinite where there is none."""

    distance: mi.Float
    """Distance along the ray, mm."""
    valid: mi.Bool
    normal: mi.Normal3f
    """Outward unit normal; +z for the planes of a slab."""
    outer: mi.Bool
    """Whether the surface is an outer one: not a border between enamel and dentin, or between layers."""
    opaque: mi.Bool
    """Whether the surface lets nothing through."""
    surface: mi.UInt32
    """Number of the surface, in scenes of several."""
    primitive: mi.UInt32
    """Number of the triangle that was hit."""
    uv: mi.Point2f
    """Barycentric weights of the triangle's second and third corner."""


def facing(omega: mi.Vector3f, hit: Hit) -> mi.Vector3f:
    """The normal of a surface on the side from which ``omega`` comes."""
    return -dr.mulsign(mi.Vector3f(hit.normal), dr.dot(omega, hit.normal))


class Geometry(Protocol):
    """Interface of a geometry of nested media."""

    modes_of: tuple[int, ...]
    """Number of shape modes of each tooth's border to dentin."""
    epsilon: float
    """Ray offset, mm."""
    opaque: bool
    """Whether any surface is opaque."""
    single: bool
    """Whether the scene is one tooth and nothing else, whose face mirrors only empty space to a camera."""

    @property
    def stained(self) -> bool:
        """Whether stains attenuate light that crosses outer faces."""

    def intersect(self, origin: mi.Point3f, direction: mi.Vector3f, enclosure: mi.UInt32, active: mi.Bool) -> Hit:
        """Next surface along a ray."""

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Distance in mm within which no surface lies; 0 where that is not known."""

    def medium(self, enclosure: mi.UInt32) -> mi.UInt32:
        """Index of the medium, 0 for empty space."""

    def beyond(self, enclosure: mi.UInt32, direction: mi.Vector3f, hit: Hit) -> mi.UInt32:
        """Place after crossing the surface."""

    def advance(self, origin: mi.Point3f, direction: mi.Vector3f, hit: Hit, through: mi.Bool) -> mi.Point3f:
        """The hit point, offset to just beyond the surface where ``through``, else to just before it."""

    def outside(self, point: mi.Point3f, hit: Hit, inside: mi.Bool) -> mi.Point3f:
        """The point that ``advance`` gave, moved to the outer side of the face where it is on the ``inside``."""

    def contrast(self, ior: mi.Float, before: mi.UInt32, after: mi.UInt32) -> mi.Float:
        """Ratio of the indices of refraction on the two sides of an outer face; ``ior`` is the teeth's."""

    def index(self, ior: mi.Float, enclosure: mi.UInt32) -> mi.Float:
        """Index of refraction at a place; ``ior`` is the teeth's."""

    def stain(self, hit: Hit, active: mi.Bool) -> mi.Float:
        """Transmittance of the stains where an outer face is crossed; called only where ``stained`` is true."""

    def on_stain(self, hit: Hit, before: mi.UInt32, after: mi.UInt32) -> mi.Bool:
        """Whether a stained face is crossed between two places."""

    def velocity(self, hit: Hit, tooth: int, active: mi.Bool) -> list[mi.Float]:
        """Normal speed n . dx/dc_m of the hit border point for each shape mode m of a tooth."""


class SlabGeometry:
    """Plane-parallel layers, laterally infinite; the lit face at z = 0, +z into the slab. Place = layer, 1..N."""

    epsilon = 0.0
    opaque = False
    stained = False
    single = True

    def __init__(self, thicknesses_mm: Sequence[float | NDArray[np.float64]], *, moving_border: bool) -> None:
        """Take each layer's thickness in mm, once for all lanes, or as an array of one per lane."""
        depths: list[float | NDArray[np.float64]] = [0.0]
        for thickness in thicknesses_mm:
            depths.append(depths[-1] + thickness)
        self.layers = len(thicknesses_mm)
        self._planes = [
            mi.Float(depth.astype(np.float32)) if isinstance(depth, np.ndarray) else dr.opaque(mi.Float, depth)
            for depth in depths
        ]
        self.modes_of: tuple[int, ...] = (int(moving_border),)

    def intersect(self, origin: mi.Point3f, direction: mi.Vector3f, enclosure: mi.UInt32, active: mi.Bool) -> Hit:
        """Next plane, exactly: the layer is known, so no tolerance is needed."""
        down = direction.z > 0
        target = dr.select(down, self._planes[1], self._planes[0])
        for layer in range(2, self.layers + 1):
            target = dr.select(
                enclosure == layer, dr.select(down, self._planes[layer], self._planes[layer - 1]), target
            )
        distance = dr.maximum((target - origin.z) / direction.z, 0)
        distance = dr.select(active & (direction.z != 0), distance, dr.inf)
        outer = dr.select(down, enclosure == self.layers, enclosure == 1)
        return Hit(
            distance,
            active & dr.isfinite(distance),
            mi.Normal3f(0, 0, 1),
            outer,
            mi.Bool(False),
            mi.UInt32(0),
            enclosure,
            mi.Point2f(0),
        )

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:  # noqa: ARG002 - planes are as cheap to hit
        """Always 0: intersecting a plane costs as little as this look-up."""
        return mi.Float(0)

    def medium(self, enclosure: mi.UInt32) -> mi.UInt32:
        """Layer number; both outsides are empty."""
        return dr.select(enclosure > self.layers, 0, enclosure)

    def beyond(self, enclosure: mi.UInt32, direction: mi.Vector3f, hit: Hit) -> mi.UInt32:  # noqa: ARG002 - meshes need the hit
        """The neighbouring layer, by the sign of the direction's z."""
        return dr.select(direction.z > 0, enclosure + 1, enclosure - 1)

    def advance(self, origin: mi.Point3f, direction: mi.Vector3f, hit: Hit, through: mi.Bool) -> mi.Point3f:  # noqa: ARG002 - meshes need it
        """The point on the plane itself, because the layer number tells the side."""
        return dr.fma(direction, dr.select(hit.valid, hit.distance, 0), origin)

    def outside(self, point: mi.Point3f, hit: Hit, inside: mi.Bool) -> mi.Point3f:  # noqa: ARG002 - meshes need them
        """The point itself, because the layer number tells the side."""
        return point

    def contrast(self, ior: mi.Float, before: mi.UInt32, after: mi.UInt32) -> mi.Float:  # noqa: ARG002 - meshes need the places
        """``ior`` itself, because all layers have one index of refraction."""
        return ior

    def index(self, ior: mi.Float, enclosure: mi.UInt32) -> mi.Float:
        """``ior`` within the layers."""
        return dr.select(self.medium(enclosure) != 0, ior, 1)

    def stain(self, hit: Hit, active: mi.Bool) -> mi.Float:  # noqa: ARG002 - faces have none
        """No stains."""
        return mi.Float(1)

    def on_stain(self, hit: Hit, before: mi.UInt32, after: mi.UInt32) -> mi.Bool:  # noqa: ARG002 - faces have none
        """No stains."""
        return mi.Bool(False)

    def depths(self, z: mi.Float, sigma: Sequence[mi.Float]) -> tuple[mi.Float, mi.Float]:
        """Optical depths from ``z`` inside straight to the lit and to the far face."""
        above, below = mi.Float(0), mi.Float(0)
        for coefficient, top, bottom in zip(sigma, self._planes[:-1], self._planes[1:], strict=True):
            above += coefficient * dr.clip(z - top, 0, bottom - top)
            below += coefficient * dr.clip(bottom - z, 0, bottom - top)
        return above, below

    def velocity(self, hit: Hit, tooth: int, active: mi.Bool) -> list[mi.Float]:  # noqa: ARG002 - there is one border
        """Speed 1 along +z of an inner border, 0 of an outer face."""
        return [dr.select(active & hit.valid & ~hit.outer, mi.Float(1), 0)]
