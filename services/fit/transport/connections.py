"""Connections from scattering vertices to all lights, with their derivatives.

Looking up every light costs as much as dozens of steps of the walk. So a lane keeps one of its last few vertices, chosen in
proportion to the most that it could contribute, and connects that one, to one light of every group (``light_groups``). All lanes
connect in the same turn, which keeps the vector units full where each vertex deciding for itself would not.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from services.fit.transport.geometry import Geometry
from services.fit.transport.lights import DARKEST_CHANCE, ROULETTE_GAIN, PointLights, shadow
from services.fit.transport.media import Media, PhaseFunction
from services.fit.transport.scores import Plan, Scores
from services.fit.transport.tally import Tally

MAP_DOUBT = 0.1
"""Relative error that a light map is trusted not to exceed where it is certain: the share of a connection that shadow rays check."""
MAP_FAILURE = 0.003
"""The same, relative to the brightest that the vertex could be: no connection goes unchecked."""


@dataclass
class Vertex:
    """One scattering vertex of each lane, kept by reservoir sampling, with all that its path had scored there."""

    point: mi.Point3f
    omega: mi.Vector3f
    place: mi.UInt32
    carried: mi.Float
    clear: mi.Float
    """Transmittance over the distance in which no surface lies: no light can be brighter."""
    counts: list[mi.UInt32]
    sums: list[mi.Float]
    border_sums: list[mi.Float]
    secondary: mi.Bool
    shape_factor: list[mi.Float]
    total: mi.Float
    """Sum of ``carried * clear`` over the vertices offered; 0 when there was none."""


@dataclass
class Doubt:
    """The one light of a vertex whose look-up is checked."""

    light: mi.UInt32
    direction: mi.Vector3f
    weight: mi.Float
    """Contribution at full transmittance."""
    expected: mi.Float
    """Transmittance by the map."""
    lengths: list[mi.Float]
    """Path lengths by the map, in the media that extinction scores ask for."""
    importance: mi.Float
    total: mi.Float
    """Importance of all lights together."""


class Connections:
    """Connects vertices of one geometry under one plan."""

    def __init__(self, geometry: Geometry, media: Media, lights: PointLights, plan: Plan, book: Scores, ior: mi.Float | None) -> None:
        self.geometry, self.media, self.lights, self.plan, self.book, self.ior = geometry, media, lights, plan, book, ior
        self.modes = geometry.modes if plan.shape else 0
        self.turns = lights.turns
        """Steps of the walk per connection."""

    def no_vertex(self) -> Vertex:
        """An empty reservoir."""

        def zeros(count: int) -> list[mi.Float]:
            return [mi.Float(0) for _ in range(count)]

        return Vertex(
            mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.UInt32(0), mi.Float(0), mi.Float(1), [mi.UInt32(0) for _ in range(self.media.count)],
            zeros(len(self.plan.scores)), zeros(self.modes), mi.Bool(False), zeros(self.modes), mi.Float(0),
        )  # fmt: skip

    def offer(self, kept: Vertex, found: Vertex, u: mi.Float, active: mi.Bool) -> Vertex:
        """Offer a vertex; ``found.total`` is ignored."""
        importance = dr.select(active, found.carried * found.clear, 0)
        total = kept.total + importance
        chosen = dr.select(active & (u * total < importance), found, kept)
        chosen.total = total
        return chosen

    def connect(self, vertex: Vertex, lane: mi.UInt32, rng: mi.PCG32, active: mi.Bool, tally: Tally) -> mi.PCG32:
        """Add the kept vertex's light from everywhere; returns the advanced generator."""

        def to_lights(vertex: Vertex, lane: mi.UInt32, rng: mi.PCG32, active: mi.Bool) -> mi.PCG32:
            kept, rng = self._look_around(vertex, lane, rng, active, tally)

            # Correct what the maps said about one light by a shadow ray, cast with a probability in proportion to the doubt.
            chance = dr.clip(ROULETTE_GAIN * kept.total * self.lights.inverse_irradiance, DARKEST_CHANCE, 1)
            casts = active & (kept.total > 0) & (rng.next_float32() < chance)
            weight = kept.weight * kept.total / (kept.importance * chance)
            dr.if_stmt((vertex, lane, kept, weight, casts), casts, correct, lambda *_: mi.Float(0), label="correction")
            return rng

        def correct(vertex: Vertex, lane: mi.UInt32, kept: Doubt, weight: mi.Float, casts: mi.Bool) -> mi.Float:
            ray = shadow(
                self.geometry, self.media, vertex.point, kept.direction, vertex.place, casts,
                measured=self.book.sigma_media, shape=self.plan.shape, thin_ior=self.ior,
            )  # fmt: skip
            self._count(vertex, lane, kept.light, kept.direction, weight * ray.transmittance(), ray.lengths, ray.border, casts, tally)
            self._count(vertex, lane, kept.light, kept.direction, -weight * kept.expected, kept.lengths, None, casts, tally)
            return weight

        return dr.if_stmt((vertex, lane, rng, active), active, to_lights, lambda _v, _l, rng, _a: rng, label="connection")

    def _look_around(self, vertex: Vertex, lane: mi.UInt32, rng: mi.PCG32, active: mi.Bool, tally: Tally) -> tuple[Doubt, mi.PCG32]:
        """Count what the light maps expect from one light of every group, and keep one of these in proportion to the doubt about it."""
        maps, groups = self.lights.maps, self.lights.groups
        doubt = 1.0 if self.plan.shape else MAP_DOUBT

        def step(
            group: mi.UInt32, rng: mi.PCG32, kept: Doubt, vertex: Vertex, lane: mi.UInt32, active: mi.Bool
        ) -> tuple[mi.UInt32, mi.PCG32, Doubt, Vertex, mi.UInt32, mi.Bool]:
            u = rng.next_float32() if groups.size > 1 else mi.Float(0)
            light, brightness = groups.choose(group, vertex.point, lambda direction: self._density(vertex, direction), u)
            seen = maps.look(light, vertex.point, active)
            # A vertex stands for all that were offered with it, and a light for its group.
            weight = vertex.total / dr.maximum(vertex.clear, 1e-30) * brightness
            expected, lengths = seen.transmittance(self.media), seen.lengths(self.book.sigma_media)
            self._count(vertex, lane, light, seen.direction, weight * expected, lengths, None, active, tally)

            importance = weight * dr.select(seen.certain, doubt * expected + MAP_FAILURE * vertex.clear, vertex.clear)
            total = kept.total + importance
            take = rng.next_float32() * total < importance
            kept = dr.select(take, Doubt(light, seen.direction, weight, expected, lengths, importance, total), kept)
            kept.total = total
            return group + 1, rng, kept, vertex, lane, active

        zero = mi.Float(0)
        kept = Doubt(mi.UInt32(0), mi.Vector3f(0, 0, 1), zero, zero, [mi.Float(0) for _ in self.book.sigma_media], mi.Float(0), mi.Float(0))
        state = dr.while_loop(
            (mi.UInt32(0), rng, kept, vertex, lane, active),
            lambda group, _r, _k, _v, _l, active: active & (group < groups.count),
            step,
            label="every group of lights",
        )
        return state[2], state[1]

    def _density(self, vertex: Vertex, direction: mi.Vector3f) -> mi.Float:
        """Phase function towards a direction, 1/sr."""
        return PhaseFunction(self.media, self.geometry.medium(vertex.place)).density(vertex.omega, direction)

    def _count(
        self,
        vertex: Vertex,
        lane: mi.UInt32,
        light: mi.UInt32,
        direction: mi.Vector3f,
        value: mi.Float,
        lengths: list[mi.Float],
        border: list[mi.Float] | None,
        active: mi.Bool,
        tally: Tally,
    ) -> None:
        """Add a connection's value to its image and, times the score of the whole path, to the derivatives."""
        slot, primary = self._slot(vertex, light), active & ~vertex.secondary
        tally.add(lane, slot, value, primary)
        medium = self.geometry.medium(vertex.place)
        terms = PhaseFunction(self.media, medium).scores(self.book.phase_fields, vertex.omega, direction)
        lengths_of = dict(zip(self.book.sigma_media, lengths, strict=True))
        for which, score in enumerate(self.book.complete(vertex.sums, vertex.counts, medium, terms, lengths_of)):
            tally.add_derivative(which, lane, slot, value * score, primary)
        for mode in range(self.modes):
            on_the_way = vertex.border_sums[mode] if border is None else vertex.border_sums[mode] + border[mode]
            factor = dr.select(vertex.secondary, vertex.shape_factor[mode], on_the_way)
            tally.add_derivative(len(self.plan.scores) + mode, lane, slot, value * factor, active)

    def _slot(self, vertex: Vertex, light: mi.UInt32) -> mi.UInt32:
        edges = self.plan.order_edges
        if not edges:
            return light
        order, bin_index = vertex.counts[0], mi.UInt32(0)
        for count in vertex.counts[1:]:
            order = order + count
        for edge in edges[1:-1]:
            bin_index += dr.select(order >= edge, mi.UInt32(1), mi.UInt32(0))
        return light * (len(edges) - 1) + bin_index
