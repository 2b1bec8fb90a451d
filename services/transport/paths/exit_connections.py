"""Connections to all lights through an outer face that bends light: from the points where walks meet the face.

No vertex inside sees a light straight on. A walk that meets the face receives light by the face's own lobe, which is
wide for a rough face. Whether a light reaches the face is known for most triangles before (``LitFaces``).

Where connections are aimed from scattering vertices too (``aimed_connections``), a walk that flew from a vertex to the
face in one leg counts by the balance heuristic, and one that comes from another part of the face in full.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from services.transport.boundary import aiming
from services.transport.boundary.model import BendingBoundary, Boundary
from services.transport.lighting.light_maps import LightView
from services.transport.lighting.lights import PointLights
from services.transport.paths.connections import Connections
from services.transport.paths.scores import Plan, Scores
from services.transport.paths.vertex import Aim, Facing, Leg, Vertex
from services.transport.paths.walker import Flight, Walker
from services.transport.scene.geometry import Geometry
from services.transport.scene.media import Media, PhaseFunction
from services.transport.scene.mesh_geometry import MeshGeometry

STEPS_PER_CONNECTION = 8
"""Steps of the walk per connection: a walk scatters many times between two meetings with the face."""
STEPS_BESIDE_AIMED = 16
"""The same where connections are aimed too, which then find most of the light."""
WALKS_PER_AIM = 4.0
"""Weight of a walk over that of an aimed connection in the balance heuristic."""
WIDENING, WIDENING_PER_MM = 0.05, 0.3
"""Roughnesses, the latter per mm of depth, by which the face's own is widened where connections are aimed, because
facets of a mesh differ from the smoothed normal, and the face bends away from it."""


class ExitConnections(Connections):
    """Connections from the outer face; ``Vertex.omega`` is the direction in which the path arrives there."""

    def __init__(
        self, geometry: Geometry, media: Media, lights: PointLights, plan: Plan, scores: Scores, boundary: Boundary
    ) -> None:
        super().__init__(geometry, media, lights, plan, scores, boundary)
        assert isinstance(boundary, BendingBoundary)
        self.faces = boundary
        # An aimed connection to a border that moves is not differentiated.
        self.aims = plan.shape is None and isinstance(geometry, MeshGeometry) and boundary.aims(lights.count)
        self.period = STEPS_BESIDE_AIMED if self.aims else STEPS_PER_CONNECTION

    def found(self, walker: Walker, flight: Flight, throughput: mi.Float) -> tuple[Vertex, mi.Bool]:
        """The vertex of walks that have met a face, just outside it, with the throughput before the face."""
        (arrival,), hit = flight.arrival, flight.hit
        throughput = arrival.throughput
        leaving = dr.dot(arrival.omega, hit.normal) > 0
        if self.geometry.stained:
            throughput = throughput * self.geometry.stain(hit, arrival.connects & leaving)
        vertex = Vertex(
            self.geometry.outside(walker.origin, hit, flight.reflects == leaving), arrival.omega, mi.UInt32(0),
            throughput, mi.Float(1), walker.scatterings, walker.sums, walker.border_sums, walker.secondary,
            walker.shape_factor, [], [Facing(mi.Vector3f(hit.normal), hit.primitive, walker.leg, [])], walker.stains,
            mi.Float(0),
        )  # fmt: skip
        return vertex, arrival.connects

    def _no_facing(self) -> list[Facing]:
        return [Facing(mi.Vector3f(0, 0, 1), mi.UInt32(0), [Leg.none()] * self.aims, [])]

    def _prepared(self, vertex: Vertex, active: mi.Bool) -> Vertex:
        if not self.aims:
            return vertex
        (facing,) = vertex.facing
        (leg,) = facing.leg
        aim = aim_of(self, leg.point, active)
        walks = WALKS_PER_AIM * PhaseFunction(self.media, leg.medium).density(leg.omega, vertex.omega)
        aim.walks = dr.select(leg.scattered, walks, 0)
        return replace(vertex, facing=[replace(facing, leg=[], aim=[aim])])

    def _look_up(self, light: mi.UInt32, vertex: Vertex, active: mi.Bool) -> LightView:
        return self.lights.maps.look_up(light, vertex.point, vertex.facing[0].primitive, active)

    def _density(self, vertex: Vertex, direction: mi.Vector3f) -> mi.Float:
        value, _ = self.faces.towards(vertex.omega, vertex.facing[0].normal, direction)
        for aim in vertex.facing[0].aim:
            value *= 1 - aimed_share(aim, vertex.omega, direction, self.faces.ior)
        return value

    def _terms(self, vertex: Vertex, direction: mi.Vector3f) -> dict[str, mi.Float]:
        if not any(score.field == "roughness" for score in self.plan.scores):
            return {}
        _, score = self.faces.towards(vertex.omega, vertex.facing[0].normal, direction)
        return {"roughness": score}

    def _medium(self, vertex: Vertex) -> mi.UInt32:  # noqa: ARG002 - the vertex lies in no medium
        return mi.UInt32(0)


def aim_of(connections: Connections, point: mi.Point3f, active: mi.Bool) -> Aim:
    """The face through which connections are aimed from a scattering vertex, without the walks' density."""
    assert isinstance(connections.geometry, MeshGeometry)
    assert isinstance(connections.boundary, BendingBoundary)
    normal, depth = connections.geometry.nearest_face(point, active)
    widened = dr.square(connections.boundary.roughness) + WIDENING**2 + dr.square(WIDENING_PER_MM * depth)
    return Aim(normal, dr.sqrt(dr.minimum(widened, 1)), mi.Float(0))


def aimed_share(aim: Aim, omega: mi.Vector3f, direction: mi.Vector3f, ior: mi.Float) -> mi.Float:
    """Share of aimed connections in the balance heuristic: none to lights that the nearest face hardly sees, nor where
    no medium scattered the walk.
    """
    aimed = aiming.density(omega, direction, aim.normal, ior, aim.roughness)
    counts = (aim.walks > 0) & (dr.dot(direction, aim.normal) > aiming.LOWEST)
    return dr.select(counts, aimed / (aimed + aim.walks), 0)
