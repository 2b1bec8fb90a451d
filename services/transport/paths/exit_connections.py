"""Connections to all lights through an outer face that bends light: from the points where walks meet the face.

No vertex inside sees a light straight on. A walk that meets the face receives light by the face's own lobe, which is
wide for a rough face. Whether a light reaches the face is known for most triangles before (``LitFaces``).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from services.transport.boundary.model import BendingBoundary, Boundary
from services.transport.lighting.light_maps import LightView
from services.transport.lighting.lights import PointLights
from services.transport.paths.connections import Connections, Facing, Vertex
from services.transport.paths.scores import Plan, Scores
from services.transport.paths.walker import Flight, Walker
from services.transport.scene.geometry import Geometry
from services.transport.scene.media import Media

STEPS_PER_CONNECTION = 8
"""Steps of the walk per connection: a walk scatters many times between two meetings with the face."""


class ExitConnections(Connections):
    """Connections from the outer face; ``Vertex.omega`` is the direction in which the path arrives there."""

    def __init__(
        self, geometry: Geometry, media: Media, lights: PointLights, plan: Plan, scores: Scores, boundary: Boundary
    ) -> None:
        super().__init__(geometry, media, lights, plan, scores, boundary)
        assert isinstance(boundary, BendingBoundary)
        self.faces = boundary
        self.period = STEPS_PER_CONNECTION

    def exit_of(self, walker: Walker, flight: Flight, geometry: Geometry) -> Vertex:
        """The vertex of walks that have met a face, just outside it."""
        (arrival,), hit = flight.arrival, flight.hit
        throughput = arrival.throughput
        leaving = dr.dot(arrival.omega, hit.normal) > 0
        if geometry.stained:
            throughput = throughput * geometry.stain(hit, arrival.connects & leaving)
        return Vertex(
            geometry.outside(walker.origin, hit, flight.reflects == leaving), arrival.omega, mi.UInt32(0), throughput,
            mi.Float(1), walker.scatterings, walker.sums, walker.border_sums, walker.secondary, walker.shape_factor, [],
            [Facing(mi.Vector3f(hit.normal), hit.primitive)], walker.stains, mi.Float(0),
        )  # fmt: skip

    def _look_up(self, light: mi.UInt32, vertex: Vertex, active: mi.Bool) -> LightView:
        return self.lights.maps.look_up(light, vertex.point, vertex.facing[0].primitive, active)

    def _density(self, vertex: Vertex, direction: mi.Vector3f) -> mi.Float:
        value, _ = self.faces.towards(vertex.omega, vertex.facing[0].normal, direction)
        return value

    def _terms(self, vertex: Vertex, direction: mi.Vector3f) -> dict[str, mi.Float]:
        if not any(score.field == "roughness" for score in self.plan.scores):
            return {}
        _, score = self.faces.towards(vertex.omega, vertex.facing[0].normal, direction)
        return {"roughness": score}

    def _medium(self, vertex: Vertex) -> mi.UInt32:  # noqa: ARG002 - the vertex lies in no medium
        return mi.UInt32(0)
