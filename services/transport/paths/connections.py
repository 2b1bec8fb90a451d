"""Connections from scattering vertices to all lights, with their derivatives.

Looking up every light costs as much as dozens of steps of the walk. So a lane keeps one of its last few vertices,
chosen in proportion to the most that it could contribute, and connects that one, to one light of every group
(``light_groups``). All lanes connect at the same step, which keeps the vector units full; a separate decision at each
vertex would not.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from services.transport.boundary.model import Boundary
from services.transport.lighting.light_maps import LightView
from services.transport.lighting.lights import DARKEST_CHANCE, ROULETTE_GAIN, PointLights, shadow
from services.transport.paths.scores import Plan, Scores
from services.transport.paths.stain_tally import StainTally
from services.transport.paths.tally import Tally
from services.transport.paths.vertex import Facing, Vertex
from services.transport.paths.walker import Flight, Walker
from services.transport.scene.geometry import Geometry, facing
from services.transport.scene.media import Media, PhaseFunction
from services.transport.scene.stain_textures import FaceCrossing

MAP_RELATIVE_ERROR = 0.1
"""Bound assumed for the relative error of a light map where it is certain. It sets the share of a connection that
shadow rays check."""
MAP_ERROR_FLOOR = 0.003
"""Bound added to that one, relative to the largest possible contribution of the vertex, so that no connection goes
unchecked."""
FAINTEST = 1e-20
"""Contribution of a vertex, as a share of the lights' mean irradiance, below which it is not worth a shadow ray: it is
below float32 resolution of any sum, and deep in a dense medium the quotient of such numbers is 0 / 0 in float32."""


@dataclass
class LookupCheck:
    """The light of a vertex whose look-up a shadow ray may check."""

    light: mi.UInt32
    direction: mi.Vector3f
    weight: mi.Float
    """Contribution at full transmittance."""
    expected: mi.Float
    """Transmittance according to the map."""
    lengths: list[mi.Float]
    """Path lengths in mm according to the map, in the media that extinction scores need."""
    importance: mi.Float
    """Weight of this light in the reservoir: the assumed error of its look-up."""
    total: mi.Float
    """Sum of the importance of all lights."""
    expected_sum: list[mi.Float]
    """Contribution of all lights according to the maps, weighted by the cotangent; empty unless stain derivatives are
    computed."""


class Connections:
    """Connections from the vertices of walks through one geometry under one plan."""

    def __init__(
        self, geometry: Geometry, media: Media, lights: PointLights, plan: Plan, scores: Scores, boundary: Boundary
    ) -> None:
        self.geometry, self.media, self.lights, self.plan, self.scores, self.boundary = (
            geometry,
            media,
            lights,
            plan,
            scores,
            boundary,
        )
        self.modes = 0 if plan.shape is None else geometry.modes_of[plan.shape]
        self.period = lights.connection_period
        """Number of steps of the walk per connection."""

    def no_vertex(self) -> Vertex:
        """An empty reservoir."""

        def zeros(count: int) -> list[mi.Float]:
            return [mi.Float(0) for _ in range(count)]

        return Vertex(
            mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.UInt32(0), mi.Float(0), mi.Float(1), self.scores.unscattered(),
            zeros(len(self.plan.scores)), zeros(self.modes), [mi.Bool(False)] * (self.plan.shape is not None),
            zeros(self.modes), [mi.Bool(False)] * self.geometry.opaque, self._no_facing(),
            [FaceCrossing.none(mi.Float(0))] * self.plan.stains, mi.Float(0),
        )  # fmt: skip

    def _no_facing(self) -> list[Facing]:
        return []

    def found(self, walker: Walker, flight: Flight, throughput: mi.Float) -> tuple[Vertex, mi.Bool]:
        """The vertex of walks that have just moved, and the lanes that offer it."""
        bound = dr.exp(-flight.sigma * dr.maximum(self.geometry.clearance(walker.origin, flight.scatters), 0))
        omega, wall = walker.omega, []
        if self.geometry.opaque:
            omega, wall = dr.select(flight.bounces, facing(omega, flight.hit), omega), [flight.bounces]
        vertex = Vertex(
            walker.origin, omega, walker.enclosure, throughput, bound, walker.scatterings, walker.sums,
            walker.border_sums, walker.secondary, walker.shape_factor, wall, [], walker.stains, mi.Float(0),
        )  # fmt: skip
        return vertex, flight.scatters | flight.bounces

    def offer(self, reservoir: Vertex, found: Vertex, u: mi.Float, active: mi.Bool) -> Vertex:
        """Offer ``found`` to ``reservoir``, with a uniform random number ``u``; ``found.total`` is ignored."""
        importance = dr.select(active, found.throughput * found.max_transmittance, 0)
        total = reservoir.total + importance
        chosen: Vertex = dr.select(active & (u * total < importance), found, reservoir)
        chosen.total = total
        return chosen

    def connect(self, vertex: Vertex, row: mi.UInt32, rng: mi.PCG32, active: mi.Bool, tally: Tally) -> mi.PCG32:
        """Add the contributions of all lights at the kept vertex to the tally; returns the advanced generator."""

        def to_lights(vertex: Vertex, row: mi.UInt32, rng: mi.PCG32, active: mi.Bool) -> mi.PCG32:
            vertex = self._prepared(vertex, active)
            check, rng = self._connect_by_maps(vertex, row, rng, active, tally)

            # Correct the maps' transmittance to one light by a shadow ray, cast with a probability proportional to the
            # assumed error.
            chance = dr.clip(ROULETTE_GAIN * check.total * self.lights.inverse_irradiance, DARKEST_CHANCE, 1)
            casts = active & (check.total * self.lights.inverse_irradiance > FAINTEST) & (rng.next_float32() < chance)
            weight = check.weight * check.total / (check.importance * chance)
            if isinstance(tally, StainTally):
                tally.credit(row, vertex.stains[0], check.expected_sum[0], active)
                ray_stains = [FaceCrossing.none(rng.next_float32())]
                dr.if_stmt(
                    (vertex, row, check, weight, ray_stains, casts),
                    casts,
                    correct_stains,
                    lambda *_: mi.Float(0),
                    label="correction",
                )
            else:
                dr.if_stmt(
                    (vertex, row, check, weight, casts), casts, correct, lambda *_: mi.Float(0), label="correction"
                )
            return rng

        def correct_stains(
            vertex: Vertex,
            row: mi.UInt32,
            check: LookupCheck,
            weight: mi.Float,
            stains: list[FaceCrossing],
            casts: mi.Bool,
        ) -> mi.Float:
            assert isinstance(tally, StainTally)
            ray = shadow(
                self.geometry,
                self.media,
                vertex.point,
                check.direction,
                vertex.enclosure,
                casts,
                boundary=self.boundary,
                stains=stains,
            )
            value = weight * tally.weight(row, check.light, casts)
            tally.credit(row, vertex.stains[0], value * (ray.transmittance() - check.expected), casts)
            tally.credit(row, ray.stains[0], value * ray.transmittance(), casts)
            return weight

        def correct(vertex: Vertex, row: mi.UInt32, check: LookupCheck, weight: mi.Float, casts: mi.Bool) -> mi.Float:
            ray = shadow(
                self.geometry, self.media, vertex.point, check.direction, vertex.enclosure, casts,
                measured=self.scores.sigma_media, shape=self.plan.shape, boundary=self.boundary,
            )  # fmt: skip
            self._count(
                vertex,
                row,
                check.light,
                check.direction,
                weight * ray.transmittance(),
                ray.lengths,
                ray.border,
                casts,
                tally,
            )
            self._count(
                vertex, row, check.light, check.direction, -weight * check.expected, check.lengths, None, casts, tally
            )
            return weight

        return dr.if_stmt(
            (vertex, row, rng, active), active, to_lights, lambda _v, _l, rng, _a: rng, label="connection"
        )

    def _prepared(self, vertex: Vertex, active: mi.Bool) -> Vertex:  # noqa: ARG002 - some connections need the mask
        """The vertex with what all its connections have in common."""
        return vertex

    def _connect_by_maps(
        self, vertex: Vertex, row: mi.UInt32, rng: mi.PCG32, active: mi.Bool, tally: Tally
    ) -> tuple[LookupCheck, mi.PCG32]:
        """Add the contributions that the light maps predict for one light of every group, and keep one of these lights
        with a probability proportional to the assumed error of its look-up.
        """
        groups = self.lights.groups
        relative_error = MAP_RELATIVE_ERROR if self.plan.shape is None and not self.plan.stains else 1.0

        def step(
            group: mi.UInt32, rng: mi.PCG32, check: LookupCheck, vertex: Vertex, row: mi.UInt32, active: mi.Bool
        ) -> tuple[mi.UInt32, mi.PCG32, LookupCheck, Vertex, mi.UInt32, mi.Bool]:
            u = rng.next_float32() if groups.size > 1 else mi.Float(0)
            light, brightness = groups.choose(
                group, vertex.point, lambda direction: self._density(vertex, direction), u
            )
            lookup = self._look_up(light, vertex, active)
            # The kept vertex represents all that were offered with it, and the chosen light its whole group.
            weight = vertex.total / dr.maximum(vertex.max_transmittance, 1e-30) * brightness
            expected, lengths = lookup.transmittance(self.media), lookup.lengths(self.scores.sigma_media)
            importance = weight * dr.select(
                lookup.certain,
                relative_error * expected + MAP_ERROR_FLOOR * vertex.max_transmittance,
                vertex.max_transmittance,
            )
            expected_sum = check.expected_sum
            if isinstance(tally, StainTally):
                cotangent = tally.weight(row, light, active)
                importance *= dr.abs(cotangent)
                expected_sum = [dr.fma(weight * expected, cotangent, check.expected_sum[0])]
            else:
                self._count(vertex, row, light, lookup.direction, weight * expected, lengths, None, active, tally)
            total = check.total + importance
            take = rng.next_float32() * total < importance
            check = dr.select(
                take,
                LookupCheck(light, lookup.direction, weight, expected, lengths, importance, total, expected_sum),
                check,
            )
            check.total, check.expected_sum = total, expected_sum
            return group + 1, rng, check, vertex, row, active

        zero = mi.Float(0)
        check = LookupCheck(
            mi.UInt32(0), mi.Vector3f(0, 0, 1), zero, zero, [mi.Float(0) for _ in self.scores.sigma_media], mi.Float(0),
            mi.Float(0), [mi.Float(0)] * self.plan.stains,
        )  # fmt: skip
        state = dr.while_loop(
            (mi.UInt32(0), rng, check, vertex, row, active),
            lambda group, _r, _k, _v, _l, active: active & (group < groups.count),
            step,
            label="every group of lights",
        )
        return state[2], state[1]

    def _count(
        self,
        vertex: Vertex,
        row: mi.UInt32,
        light: mi.UInt32,
        direction: mi.Vector3f,
        value: mi.Float,
        lengths: list[mi.Float],
        border: list[mi.Float] | None,
        active: mi.Bool,
        tally: Tally,
    ) -> None:
        """Add a connection's value to its image and, times the score of the whole path, to the derivatives."""
        slot, primary = self._slot(vertex, light), active & vertex.primary
        tally.add(row, slot, value, primary)
        medium = self._medium(vertex)
        terms = self._terms(vertex, direction)
        lengths_of = dict(zip(self.scores.sigma_media, lengths, strict=True))
        for which, score in enumerate(self.scores.complete(vertex.sums, vertex.scatterings, medium, terms, lengths_of)):
            tally.add_derivative(which, row, slot, value * score, primary)
        for mode in range(self.modes):
            border_score = vertex.border_sums[mode] if border is None else vertex.border_sums[mode] + border[mode]
            factor = dr.select(vertex.primary, border_score, vertex.shape_factor[mode])
            tally.add_derivative(len(self.plan.scores) + mode, row, slot, value * factor, active)

    def _medium(self, vertex: Vertex) -> mi.UInt32:
        """Medium in which a vertex scatters, or the wall (number ``media.count``) where it lies on the wall."""
        medium = self.geometry.medium(vertex.enclosure)
        return dr.select(vertex.wall[0], mi.UInt32(self.media.count), medium) if vertex.wall else medium

    def _look_up(self, light: mi.UInt32, vertex: Vertex, active: mi.Bool) -> LightView:
        """What the maps say of the way from a vertex to a light."""
        return self.lights.maps.look_up(light, vertex.point, vertex.enclosure, active)

    def _terms(self, vertex: Vertex, direction: mi.Vector3f) -> dict[str, mi.Float]:
        """Scores of the connection's change of direction, by field."""
        return PhaseFunction(self.media, self._medium(vertex)).scores(self.scores.phase_fields, vertex.omega, direction)

    def _density(self, vertex: Vertex, direction: mi.Vector3f) -> mi.Float:
        """Phase function, or on a wall the diffuse reflection of a white surface, towards a direction, 1/sr."""
        density = PhaseFunction(self.media, self._medium(vertex)).density(vertex.omega, direction)
        if vertex.wall:
            density = dr.select(vertex.wall[0], dr.maximum(dr.dot(vertex.omega, direction), 0) * dr.inv_pi, density)
        return density

    def _slot(self, vertex: Vertex, light: mi.UInt32) -> mi.UInt32:
        edges = self.plan.order_edges
        if not edges:
            return light
        order, bin_index = self.scores.order(vertex.scatterings), mi.UInt32(0)
        for edge in edges[1:-1]:
            bin_index += dr.select(order >= edge, mi.UInt32(1), mi.UInt32(0))
        return light * (len(edges) - 1) + bin_index
