"""Connections to all lights through an outer face that bends light: from the points where walks meet the face.

No vertex inside sees a light straight on. A walk that meets the face receives light by the face's own lobe, which is
wide for a rough face. Whether a light reaches the face is known for most triangles before (``LitFaces``).

In a mouth only faces to air count, not those between a root and the gums, and a wall scatters as a white surface does.
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
from services.transport.scene.geometry import Geometry, facing
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
        self.aims = (
            plan.shape is None
            and isinstance(geometry, MeshGeometry)
            and len(geometry.recipe.teeth) == 1
            and boundary.aims(lights.count)
        )
        self.period = STEPS_BESIDE_AIMED if self.aims else STEPS_PER_CONNECTION

    def found(self, walker: Walker, flight: Flight, throughput: mi.Float) -> tuple[Vertex, mi.Bool]:
        """The vertex of walks that have met a face, just outside it, with the throughput before the face; and of those
        that a wall scatters.
        """
        (arrival,), hit, geometry = flight.arrival, flight.hit, self.geometry
        leaving, connects = dr.dot(arrival.omega, hit.normal) > 0, arrival.connects
        omega, before, wall, ior = arrival.omega, arrival.throughput, [], []
        inside = flight.reflects == leaving
        if not geometry.single:
            normal = mi.Vector3f(hit.normal)
            within, outside = (geometry.beyond(walker.enclosure, towards, hit) for towards in (-normal, normal))
            connects = connects & (geometry.medium(outside) == 0) & ~hit.opaque
            ior = [geometry.index(self.faces.ior, within)]
        if geometry.stained:
            before = before * geometry.stain(hit, connects & leaving)
        if geometry.opaque:
            wall, inside = [flight.bounces], inside & ~flight.bounces
            omega = dr.select(flight.bounces, facing(omega, hit), omega)
            before, connects = dr.select(flight.bounces, throughput, before), connects | flight.bounces
        vertex = Vertex(
            geometry.outside(walker.origin, hit, inside), omega, mi.UInt32(0), before, mi.Float(1), walker.scatterings,
            walker.sums, walker.border_sums, walker.secondary, walker.shape_factor, wall,
            [Facing(mi.Vector3f(hit.normal), hit.primitive, ior, walker.leg, [])], walker.stains, mi.Float(0),
        )  # fmt: skip
        return vertex, connects

    def _no_facing(self) -> list[Facing]:
        ior = [] if self.geometry.single else [mi.Float(1)]
        return [Facing(mi.Vector3f(0, 0, 1), mi.UInt32(0), ior, [Leg.none()] * self.aims, [])]

    def _prepared(self, vertex: Vertex, active: mi.Bool) -> Vertex:
        if not self.aims:
            return vertex
        (face,) = vertex.facing
        (leg,) = face.leg
        aim = aim_of(self, leg.point, active)
        walks = WALKS_PER_AIM * PhaseFunction(self.media, leg.medium).density(leg.omega, vertex.omega)
        aim.walks = dr.select(leg.scattered, walks, 0)
        return replace(vertex, facing=[replace(face, leg=[], aim=[aim])])

    def _look_up(self, light: mi.UInt32, vertex: Vertex, active: mi.Bool) -> LightView:
        return self.lights.maps.look_up(light, vertex.point, vertex.facing[0].primitive, active)

    def _density(self, vertex: Vertex, direction: mi.Vector3f) -> mi.Float:
        value, _ = self._received(vertex, direction)
        for aim in vertex.facing[0].aim:
            value *= 1 - aimed_share(aim, vertex.omega, direction, self.faces.ior)
        if vertex.wall:
            value = dr.select(vertex.wall[0], dr.maximum(dr.dot(vertex.omega, direction), 0) * dr.inv_pi, value)
        return value

    def _received(self, vertex: Vertex, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """What the face receives from a light, and the derivative of its logarithm to the roughness."""
        (face,) = vertex.facing
        return self.faces.towards(vertex.omega, face.normal, direction, *face.ior)

    def _terms(self, vertex: Vertex, direction: mi.Vector3f) -> dict[str, mi.Float]:
        if not any(score.field == "roughness" for score in self.plan.scores):
            return {}
        return {"roughness": self._received(vertex, direction)[1]}

    def _medium(self, vertex: Vertex) -> mi.UInt32:
        """None but the wall."""
        return dr.select(vertex.wall[0], mi.UInt32(self.media.count), mi.UInt32(0)) if vertex.wall else mi.UInt32(0)


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
