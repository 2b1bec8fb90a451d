"""The state of walks under way, one per lane, and the result of one of their steps."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi

from services.transport.paths.scores import Scatterings
from services.transport.paths.vertex import Leg, Vertex
from services.transport.scene.border import Crossing
from services.transport.scene.geometry import Hit
from services.transport.scene.stain_textures import FaceCrossing


@dataclass
class Walker:
    """State of every lane: a path under way, its scores so far, its row and its sample number."""

    rng: mi.PCG32
    origin: mi.Point3f
    omega: mi.Vector3f
    """Unit propagation direction."""
    enclosure: mi.UInt32
    """Solids or slab layer that the origin lies in; see ``geometry``."""
    weight: mi.Float
    """Throughput without the albedos, which follow from ``scatterings``."""
    reference: mi.Float
    """Throughput with which Russian roulette compares the present one."""
    scatterings: Scatterings
    steps: list[mi.UInt32]
    """Number of flights so far; empty unless it is limited."""
    sums: list[mi.Float]
    """Scores of the media's parameters so far."""
    border_sums: list[mi.Float]
    """Scores of the shape modes so far."""
    border_crossing: list[Crossing]
    """Border crossing from which the secondary walk will start; empty unless shape derivatives are computed."""
    stains: list[FaceCrossing]
    """One of the stained faces crossed; empty unless stain derivatives are computed."""
    vertex: Vertex | None
    """Scattering vertex that waits for its connection to the lights."""
    aimed: list[Vertex]
    """Scattering vertex that waits for its connection aimed through the nearest face; empty unless there are any."""
    leg: list[Leg]
    """The flight under way; empty likewise."""
    connection_step: mi.UInt32
    """Steps since the last connection."""
    secondary: list[mi.Bool]
    """Whether this is a border crossing's secondary walk, which feeds the shape derivatives alone; empty unless these
    are computed."""
    shape_factor: list[mi.Float]
    """For a secondary walk: dt_b of each mode over the sum of their magnitudes, with the sign of the scattering
    difference."""
    row: mi.UInt32
    """Row of the tally to which the path belongs."""
    sample: mi.UInt32
    active: mi.Bool
    """Lanes with a path under way."""
    working: mi.Bool
    """Lanes with a path under way, and those that wait for their next row."""

    @property
    def primary(self) -> mi.Bool:
        """Lanes whose walk is not a secondary one."""
        return ~self.secondary[0] if self.secondary else mi.Bool(True)


@dataclass
class Arrival:
    """A path that meets an outer face, before the face changes it."""

    omega: mi.Vector3f
    throughput: mi.Float
    connects: mi.Bool
    """Lanes whose path connects to the lights from there."""


@dataclass
class Flight:
    """Result of one free flight."""

    medium: mi.UInt32
    """Medium of the flight, 0 for empty space."""
    sigma: mi.Float
    """Extinction of that medium, per mm."""
    hit: Hit
    distance: mi.Float
    """Sampled distance to the next scattering, mm."""
    scatters: mi.Bool
    """Whether the path scatters before any surface."""
    meets: mi.Bool
    """Whether a surface is reached."""
    reflects: mi.Bool
    """Whether that surface reflects the path."""
    bounces: mi.Bool
    """Whether that surface is opaque and reflects diffusely. A surface that does neither is crossed."""
    onward: mi.Vector3f
    """Direction after that surface, unless it is opaque."""
    roughness_score: mi.Float
    """Score of what that surface did."""
    arrival: list[Arrival] = field(default_factory=list)
    """The path before it met that surface; empty unless the surface bends light."""
