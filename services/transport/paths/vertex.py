"""The vertex of a walk that waits for its connection to the lights."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from services.transport.paths.scores import Scatterings
from services.transport.scene.stain_textures import FaceCrossing


@dataclass
class Leg:
    """The flight on which a walk is, from where it last changed its direction."""

    point: mi.Point3f
    omega: mi.Vector3f
    """Direction before that change."""
    medium: mi.UInt32
    """Medium that scattered it."""
    scattered: mi.Bool
    """Whether a medium did it, no outer face, where connections are aimed."""

    @staticmethod
    def none() -> Leg:
        """The leg of a walk that has not begun."""
        return Leg(mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.UInt32(0), mi.Bool(False))


@dataclass
class Aim:
    """What the density of connections that were aimed from a leg's start depends on, beside the light."""

    normal: mi.Vector3f
    """Outward unit normal of the nearest face."""
    roughness: mi.Float
    """GGX roughness of the samples."""
    walks: mi.Float
    """Density of walks in the leg's direction times their weight in the heuristic, 1/sr; 0 where none were aimed."""


@dataclass
class Facing:
    """An outer face that bends light, at the vertex from which a path connects through it."""

    normal: mi.Vector3f
    """Outward unit normal."""
    primitive: mi.UInt32
    """Number of the triangle."""
    ior: list[mi.Float]
    """Index of refraction of the solid behind it; empty where all solids have that of the teeth."""
    leg: list[Leg]
    """The leg on which the path arrived; empty unless connections are aimed too."""
    aim: list[Aim]
    """The same as densities, while the vertex is connected; else empty."""


@dataclass
class Vertex:
    """One scattering vertex of each lane, kept by reservoir sampling, with all the scores that its path had there."""

    point: mi.Point3f
    omega: mi.Vector3f
    """Propagation direction of the path before the vertex scatters it."""
    enclosure: mi.UInt32
    throughput: mi.Float
    """Throughput of the path, albedos included."""
    max_transmittance: mi.Float
    """Transmittance over the distance in which no surface lies: an upper bound of the transmittance to any light."""
    scatterings: Scatterings
    sums: list[mi.Float]
    border_sums: list[mi.Float]
    secondary: list[mi.Bool]
    """Whether the path is a border crossing's secondary walk; empty unless shape derivatives are computed."""
    shape_factor: list[mi.Float]
    wall: list[mi.Bool]
    """Whether the vertex lies on an opaque surface, whose normal ``omega`` then is; empty in scenes without such
    surfaces."""
    facing: list[Facing]
    """The outer face that the vertex lies on; empty unless that face bends light."""
    stains: list[FaceCrossing]
    """One of the stained faces that the path crossed; empty unless stain derivatives are computed."""
    total: mi.Float
    """Sum of ``throughput * max_transmittance`` over the vertices offered; 0 when there was none."""

    @property
    def primary(self) -> mi.Bool:
        """Lanes whose path is not a secondary walk."""
        return ~self.secondary[0] if self.secondary else mi.Bool(True)
