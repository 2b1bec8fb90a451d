"""Connections from scattering vertices to all lights, aimed through the nearest part of an outer face that bends light.

A direction inside is drawn from which that face would pass light on to one of the lights, and followed to the face
that it really meets. Walks that arrive there by chance are the other way to find the same paths, and both count by the
balance heuristic (Veach and Guibas 1995). The light that a smooth plane of the nearest normal would pass on is a
control variate: it is added for all lights, and subtracted for the chosen one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from services.transport.boundary import aiming
from services.transport.boundary.model import BendingBoundary, Boundary
from services.transport.lighting.light_maps import DARK_DEPTH
from services.transport.lighting.lights import PointLights, shadow
from services.transport.optics import fresnel, phase
from services.transport.paths.connections import FAINTEST, Connections
from services.transport.paths.exit_connections import WALKS_PER_AIM, aim_of, aimed_share
from services.transport.paths.scores import Plan, Scores
from services.transport.paths.tally import Tally
from services.transport.paths.vertex import Aim, Vertex
from services.transport.paths.walker import Flight, Walker
from services.transport.scene.geometry import DENTIN, Geometry
from services.transport.scene.media import Media
from services.transport.scene.mesh_geometry import MeshGeometry

STEPS_PER_AIM = 8
"""Steps of the walk per connection; it divides those of ``exit_connections``."""
ROULETTE_GAIN = 2.0
DARKEST_CHANCE = 0.03
"""A direction is followed with probability clip(``ROULETTE_GAIN`` x expected contribution, ``DARKEST_CHANCE``, 1)."""
UNEXPECTED = 0.005
"""Share of the largest possible contribution with which lights are drawn that the nearest face does not promise."""
BLUNTED = 0.6
"""Factor of a mean cosine, by which a lobe is widened to stand for light from many directions."""
MAX_DEPTH = 30.0
"""Largest optical depth that decides which vertex is kept."""
CLEARANCE_ERROR_MM = 0.1
"""Usual distance in mm by which the clearance falls short of the distance to the next surface."""


@dataclass
class Place:
    """A vertex and the layers between it and the nearest face."""

    aim: Aim
    lengths_mm: list[mi.Float]
    """Length in each medium along the normal."""
    depth: mi.Float
    """Optical depth along the normal."""
    floor: mi.Float
    """Expected contribution of lights that the face does not promise, over their irradiance."""


@dataclass
class Target:
    """The light to which a vertex is connected by a direction."""

    light: mi.UInt32
    direction: mi.Vector3f
    inside: mi.Vector3f
    """Direction that a smooth plane would bend towards the light."""
    expected: mi.Float
    """Contribution according to the plane."""
    throughput: mi.Float
    """Throughput over the probability of the light within its group, and over its irradiance."""
    strength: mi.Float
    """What the choice of group was in proportion to."""
    total: mi.Float
    """Its sum over all groups."""


@dataclass
class Flown:
    """A ray on its way to the outer face."""

    point: mi.Point3f
    enclosure: mi.UInt32
    depth: mi.Float
    """Optical depth so far."""
    lengths: list[mi.Float]
    """Length in mm in each of the media that extinction scores need."""
    stain: mi.Float
    """Transmittance of the stain on the face."""
    normal: mi.Vector3f
    """Normal of the outer face."""
    primitive: mi.UInt32
    """Triangle of the outer face."""
    arrives: mi.Bool
    alive: mi.Bool


class AimedConnections(Connections):
    """Connections from scattering vertices through the outer face."""

    def __init__(
        self, geometry: Geometry, media: Media, lights: PointLights, plan: Plan, scores: Scores, boundary: Boundary
    ) -> None:
        super().__init__(geometry, media, lights, plan, scores, boundary)
        assert isinstance(boundary, BendingBoundary)
        assert isinstance(geometry, MeshGeometry)
        self.faces, self.mesh = boundary, geometry
        self.period = STEPS_PER_AIM

    def found(self, walker: Walker, flight: Flight, throughput: mi.Float) -> tuple[Vertex, mi.Bool]:
        """Scattering vertices, in a mouth those of the fitted tooth below air; they are kept in proportion to what may
        come through the nearest face, which is more where they scatter towards it.
        """
        vertex, _ = super().found(walker, flight, throughput)
        normal, depth_mm = self.mesh.nearest_face(vertex.point, flight.scatters)
        offered = flight.scatters & self.mesh.is_below_air(vertex.enclosure, depth_mm)
        medium = self._medium(vertex)
        depth = self._optical_depth(self._lengths(vertex, depth_mm, offered))
        g = BLUNTED * self.media.pick(self.media.g1, medium)
        towards = phase.density(g, phase.deviation(g, vertex.omega, normal))
        bound = dr.exp(-dr.minimum(depth, MAX_DEPTH)) * towards
        return replace(vertex, max_transmittance=bound), offered

    def connect(self, vertex: Vertex, row: mi.UInt32, rng: mi.PCG32, active: mi.Bool, tally: Tally) -> mi.PCG32:
        """Add the contributions of all lights at the kept vertex to the tally; returns the advanced generator."""

        def to_lights(vertex: Vertex, row: mi.UInt32, rng: mi.PCG32, active: mi.Bool) -> mi.PCG32:
            place = self._place(vertex, active)
            target, rng = self._choose(vertex, place, row, rng, active, tally)
            size = target.total * self.lights.inverse_irradiance
            chance = dr.clip(ROULETTE_GAIN * size, DARKEST_CHANCE, 1)
            casts = active & (size > FAINTEST) & (rng.next_float32() < chance)
            u, v = rng.next_float32(), rng.next_float32()
            inverse = target.total / (target.strength * chance)
            dr.if_stmt(
                (vertex, place, target, row, inverse, u, v, casts), casts, aim, lambda *_: mi.Float(0), label="aim"
            )
            return rng

        def aim(
            vertex: Vertex, place: Place, target: Target, row: mi.UInt32, inverse: mi.Float, u: mi.Float, v: mi.Float,
            casts: mi.Bool,
        ) -> mi.Float:  # fmt: skip
            self._follow(vertex, place, target, row, inverse, u, v, casts, tally)
            self._count_expected(vertex, place, target, row, -inverse, casts, tally)
            return inverse

        return dr.if_stmt(
            (vertex, row, rng, active), active, to_lights, lambda _v, _l, rng, _a: rng, label="aimed connection"
        )

    def _place(self, vertex: Vertex, active: mi.Bool) -> Place:
        aim = aim_of(self, vertex.point, active)
        _, depth_mm = self.mesh.nearest_face(vertex.point, active)
        lengths = self._lengths(vertex, depth_mm, active)
        floor = UNEXPECTED * vertex.max_transmittance
        return Place(aim, lengths, self._optical_depth(lengths), floor)

    def _lengths(self, vertex: Vertex, depth_mm: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Length in mm in each medium from a vertex to the nearest face: above dentin lies enamel, and the next surface
        is the border.
        """
        to_border = dr.maximum(self.geometry.clearance(vertex.point, active), 0) + CLEARANCE_ERROR_MM
        below = dr.select(self._medium(vertex) == DENTIN, dr.minimum(to_border, depth_mm), 0)
        others = [mi.Float(0) for _ in self.media.sigma[DENTIN:]]
        return [depth_mm - below, below, *others][: len(self.media.sigma)]

    def _optical_depth(self, lengths_mm: list[mi.Float]) -> mi.Float:
        return sum((s * length for s, length in zip(self.media.sigma, lengths_mm, strict=True)), start=mi.Float(0))

    def _expected(self, vertex: Vertex, place: Place, direction: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
        """Contribution over the throughput and the light's irradiance that a smooth plane promises, 1/sr, and the
        direction inside.
        """
        outside = dr.dot(direction, place.aim.normal)
        inside = aiming.bent(direction, place.aim.normal, self.faces.ior)
        cosine = dr.dot(inside, place.aim.normal)
        scattered = self._density(vertex, inside)
        through = (1 - fresnel.reflectance(dr.clip(outside, 0, 1), self.faces.ior)) / dr.square(self.faces.ior)
        share = dr.rcp(1 + WALKS_PER_AIM * dr.square(place.aim.roughness) * scattered)
        promised = scattered * dr.exp(-place.depth / cosine) * through * outside / cosine * share
        return dr.select(outside > aiming.LOWEST, promised, 0), inside

    def _choose(
        self, vertex: Vertex, place: Place, row: mi.UInt32, rng: mi.PCG32, active: mi.Bool, tally: Tally
    ) -> tuple[Target, mi.PCG32]:
        """Add the contributions that the nearest face promises for one light of every group, and keep one of these
        lights in proportion to them.
        """
        groups = self.lights.groups

        def strength(direction: mi.Vector3f, vertex: Vertex, place: Place) -> mi.Float:
            return self._expected(vertex, place, direction)[0] + place.floor

        def step(
            group: mi.UInt32, rng: mi.PCG32, kept: Target, vertex: Vertex, place: Place, row: mi.UInt32, active: mi.Bool
        ) -> tuple[mi.UInt32, mi.PCG32, Target, Vertex, Place, mi.UInt32, mi.Bool]:
            u = rng.next_float32() if groups.size > 1 else mi.Float(0)
            light, brightness = groups.choose(group, vertex.point, lambda towards: strength(towards, vertex, place), u)
            direction, falloff = self.lights.seen_from(light, vertex.point, active)
            promised, inside = self._expected(vertex, place, direction)
            # The kept vertex represents all that were offered with it, and the chosen light its whole group.
            importance = vertex.total / dr.maximum(vertex.max_transmittance, 1e-30) * brightness
            share = importance / (promised + place.floor)
            found = Target(light, direction, inside, share * promised, share / falloff, importance, mi.Float(0))
            self._count_expected(vertex, place, found, row, mi.Float(1), active, tally)
            total = kept.total + importance
            kept = dr.select(rng.next_float32() * total < importance, found, kept)
            kept.total = total
            return group + 1, rng, kept, vertex, place, row, active

        up, zero = mi.Vector3f(0, 0, 1), mi.Float(0)
        state = dr.while_loop(
            (
                mi.UInt32(0),
                rng,
                Target(mi.UInt32(0), up, up, zero, zero, zero, mi.Float(0)),
                vertex,
                place,
                row,
                active,
            ),
            lambda group, _r, _k, _v, _p, _l, active: active & (group < groups.count),
            step,
            label="every group of lights",
        )
        return state[2], state[1]

    def _count_expected(
        self,
        vertex: Vertex,
        place: Place,
        target: Target,
        row: mi.UInt32,
        factor: mi.Float,
        active: mi.Bool,
        tally: Tally,
    ) -> None:
        """Count what the plane promises; any scores will do, as what is added is subtracted with the same ones."""
        slant = dr.rcp(dr.dot(target.inside, place.aim.normal))
        lengths = [place.lengths_mm[medium - 1] * slant for medium in self.scores.sigma_media]
        self._count(vertex, row, target.light, target.inside, factor * target.expected, lengths, None, active, tally)

    def _follow(
        self,
        vertex: Vertex,
        place: Place,
        target: Target,
        row: mi.UInt32,
        inverse: mi.Float,
        u: mi.Float,
        v: mi.Float,
        active: mi.Bool,
        tally: Tally,
    ) -> None:
        """Follow one direction to the face, and count what arrives from the light."""
        aim, ior = place.aim, self.faces.ior
        lifted = aiming.lifted(target.direction, aim.normal)
        omega = aiming.sample(lifted, aim.normal, ior, aim.roughness, u, v)
        drawn = aiming.density(omega, lifted, aim.normal, ior, aim.roughness)
        flown = self._fly(vertex, omega, active)
        view = self.lights.maps.look_up(target.light, flown.point, flown.primitive, flown.arrives)
        scattered = self._density(vertex, omega)
        passed, score = self.faces.towards(omega, flown.normal, view.direction)
        share = aimed_share(replace(aim, walks=WALKS_PER_AIM * scattered), omega, view.direction, ior)
        value = target.throughput * inverse * scattered * dr.exp(-flown.depth) * flown.stain * passed * view.falloff
        value = dr.select(flown.arrives & (drawn > 0), value * share / dr.maximum(drawn, 1e-30), 0)
        unknown = flown.arrives & ~view.certain & (value > 0)

        def cast(flown: Flown, direction: mi.Vector3f, unknown: mi.Bool) -> mi.Float:
            return shadow(
                self.geometry, self.media, flown.point, direction, flown.enclosure, unknown, boundary=self.boundary
            ).transmittance()

        seen = dr.if_stmt(
            (flown, view.direction, unknown), unknown, cast, lambda *_: mi.Float(0), label="shadow of an aimed ray"
        )
        value *= dr.select(unknown, seen, view.surface)
        vertex = replace(vertex, sums=self.scores.boundary(vertex.sums, score))
        self._count(vertex, row, target.light, omega, value, flown.lengths, None, active & (value > 0), tally)

    def _fly(self, vertex: Vertex, omega: mi.Vector3f, active: mi.Bool) -> Flown:
        """Fly straight to the outer face."""

        def step(flown: Flown, omega: mi.Vector3f) -> tuple[Flown, mi.Vector3f]:
            medium = self.geometry.medium(flown.enclosure)
            hit = self.geometry.intersect(flown.point, omega, flown.enclosure, flown.alive)
            length = dr.select(hit.valid, hit.distance, 0)
            flown.depth = dr.fma(self.media.extinction(medium), length, flown.depth)
            flown.lengths = [
                total + dr.select(medium == k, length, 0)
                for k, total in zip(self.scores.sigma_media, flown.lengths, strict=True)
            ]
            outer = hit.valid & hit.outer
            if self.geometry.stained:
                flown.stain *= self.geometry.stain(hit, outer)
            flown.enclosure = dr.select(hit.valid, self.geometry.beyond(flown.enclosure, omega, hit), flown.enclosure)
            flown.point = dr.select(hit.valid, self.geometry.advance(flown.point, omega, hit, hit.valid), flown.point)
            flown.normal = dr.select(outer, mi.Vector3f(hit.normal), flown.normal)
            flown.primitive = dr.select(outer, hit.primitive, flown.primitive)
            arrives = outer & (flown.depth < DARK_DEPTH)
            if not self.geometry.single:
                arrives &= ~hit.opaque & (self.geometry.medium(flown.enclosure) == 0)
            flown.arrives |= arrives
            flown.alive &= hit.valid & ~outer & (flown.depth < DARK_DEPTH)
            return flown, omega

        begun = Flown(
            vertex.point, vertex.enclosure, mi.Float(0), [mi.Float(0) for _ in self.scores.sigma_media], mi.Float(1),
            mi.Vector3f(0, 0, 1), mi.UInt32(0), mi.Bool(False), mi.Bool(active),
        )  # fmt: skip
        flown: Flown
        flown, _ = dr.while_loop((begun, omega), lambda flown, _: flown.alive, step, label="to the outer face")
        return flown
