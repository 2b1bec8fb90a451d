"""The state of walks under way, a lane each, and what one step of them met."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from services.fit.transport.gradients.border import Crossing
from services.fit.transport.gradients.stains import FaceCrossing
from services.fit.transport.paths.connections import Vertex
from services.fit.transport.paths.scores import Scatterings
from services.fit.transport.scene.geometry import Hit


@dataclass
class Walker:
    """State of every lane: a path under way, what it has scored, and which sample of the lane it is."""

    rng: mi.PCG32
    origin: mi.Point3f
    omega: mi.Vector3f
    place: mi.UInt32
    weight: mi.Float
    """Throughput without the albedos, which are counted."""
    reference: mi.Float
    """Throughput against which roulette compares."""
    so_far: Scatterings
    steps: list[mi.UInt32]
    """Flights so far; empty unless they are limited."""
    sums: list[mi.Float]
    border_sums: list[mi.Float]
    kept: Crossing
    stains: list[FaceCrossing]
    """One of the stained faces crossed; empty unless they are asked for."""
    vertex: Vertex | None
    """Waits for its connection to the lights."""
    turn: mi.UInt32
    """Steps since the last connection."""
    secondary: mi.Bool
    """Whether this is a border crossing's secondary walk; it feeds the shape derivatives alone."""
    shape_factor: list[mi.Float]
    """Of a secondary walk: dt_b of each mode relative to their sum, with the sign of the scattering difference."""
    lane: mi.UInt32
    sample: mi.UInt32
    active: mi.Bool


@dataclass
class Flight:
    """What one step of the walk met."""

    medium: mi.UInt32
    sigma: mi.Float
    hit: Hit
    distance: mi.Float
    scatters: mi.Bool
    meets: mi.Bool
    """A surface is reached ..."""
    reflects: mi.Bool
    """... and reflects like a mirror, or ..."""
    bounces: mi.Bool
    """... is opaque and reflects diffusely, else it is crossed."""
