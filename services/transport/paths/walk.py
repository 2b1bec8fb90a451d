"""The nested-media walk: free flights, crossings, scattering, connections to all lights, and scores for derivatives.

One loop serves camera walks in a tooth, which connect to point lights, and walks in a flat slab, which count the light
that leaves either face. Code for features that a scene lacks is absent from its kernel.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from services.transport.boundary.model import Boundary, FlatBoundary
from services.transport.lighting.lights import PointLights, shadow
from services.transport.optics.free_flight import minus_log1m, one_minus_exp
from services.transport.paths.aimed_connections import AimedConnections
from services.transport.paths.connections import Connections
from services.transport.paths.exit_connections import ExitConnections
from services.transport.paths.exits import Exits
from services.transport.paths.rows import Rows
from services.transport.paths.scores import Plan, Scores
from services.transport.paths.starts import CameraStart, LightStart, SlabStart, no_stream
from services.transport.paths.tally import Tally
from services.transport.paths.vertex import Leg
from services.transport.paths.walker import Arrival, Flight, Walker
from services.transport.scene.border import BorderScattering, inverse_cosine, no_crossing, offer
from services.transport.scene.geometry import Geometry, SlabGeometry, facing
from services.transport.scene.media import Media, PhaseFunction
from services.transport.scene.stain_textures import FaceCrossing

ROULETTE_WEIGHT = 0.1
"""Fraction of the reference weight below which a path survives in proportion to its weight."""


class Walk:
    """The walk through one geometry under one plan; call ``run``."""

    def __init__(
        self,
        geometry: Geometry,
        media: Media,
        lights: PointLights | None,
        start: CameraStart | LightStart | SlabStart,
        plan: Plan,
        boundary: Boundary,
    ) -> None:
        self.geometry, self.media, self.lights, self.start, self.plan = geometry, media, lights, start, plan
        self.boundary = boundary
        media.two_lobes |= any(score.field == "beta" for score in plan.scores)
        self.scores = Scores(plan, media)
        self.connections: Connections | None = None
        self.aiming: list[AimedConnections] = []
        if lights is not None:
            kind = ExitConnections if boundary.bends else Connections
            self.connections = kind(geometry, media, lights, plan, self.scores, boundary)
            if isinstance(self.connections, ExitConnections) and self.connections.aims:
                self.aiming = [AimedConnections(geometry, media, lights, plan, self.scores, boundary)]
        self.modes = 0 if plan.shape is None else geometry.modes_of[plan.shape]
        self.limited = int(plan.most_steps is not None)
        self.slots = 2 + self.limited if lights is None else lights.count * max(len(plan.order_edges) - 1, 1)
        self.exits: Exits | None = None
        if plan.exit_cosines or plan.ring_edges_mm:
            assert isinstance(geometry, SlabGeometry)
            assert isinstance(boundary, FlatBoundary)
            self.exits = Exits(geometry, media, plan, boundary, first_slot=self.slots)
            self.slots += self.exits.slots

    def run(self, samples: int, tally: Tally | None = None) -> Tally:
        """Tally of ``samples`` paths in every row, evaluated; a plan for stains needs a tally of its own kind."""
        tally = tally or Tally(self.start.rows, self.slots, len(self.plan.scores) + self.modes)
        self.trace(samples, tally)
        tally.evaluate()
        return tally

    def trace(self, samples: int, tally: Tally) -> None:
        """Record the loop; it adds to ``tally`` without evaluating it.

        Dr.Jit would record a body again, four times in nested loops, to take constant state out of it. This is turned
        off, and such state left out by hand: recording is half the time of a small image.
        """
        rows = Rows(self.start.rows, samples, fixed=self.start.fixed_lanes)

        def zeros(count: int) -> list[mi.Float]:
            return [mi.Float(0) for _ in range(count)]

        # No lane has a row yet; all take their first one in the first step, in which all lanes would connect.
        walker = Walker(
            rng=no_stream(),
            origin=dr.zeros(mi.Point3f, self.start.rows),
            omega=dr.zeros(mi.Vector3f, self.start.rows),
            enclosure=mi.UInt32(0),
            weight=mi.Float(0),
            reference=mi.Float(0),
            scatterings=self.scores.unscattered(),
            steps=[mi.UInt32(0) for _ in range(self.limited)],
            sums=self.scores.zero(),
            border_sums=zeros(self.modes),
            border_crossing=[no_crossing(self.modes)] * (self.plan.shape is not None),
            stains=[FaceCrossing.none(mi.Float(0)) for _ in range(self.plan.stains)],
            vertex=None if self.connections is None else self.connections.no_vertex(),
            aimed=[aiming.no_vertex() for aiming in self.aiming],
            leg=[Leg.none() for _ in self.aiming],
            connection_step=mi.UInt32(0 if self.connections is None else self.connections.period - 1),
            secondary=[mi.Bool(False)] * (self.plan.shape is not None),
            shape_factor=zeros(self.modes),
            row=rows.before_first(),
            sample=mi.UInt32(0),
            active=mi.Bool(False),
            working=rows.lanes(),
        )
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            dr.while_loop(
                (walker,), lambda walker: walker.working, lambda one: (self._step(one, tally, rows),), label="walk"
            )

    def _step(self, walker: Walker, tally: Tally, rows: Rows) -> Walker:
        before = mi.UInt64(walker.rng.state)
        throughput = self._throughput(walker)
        flight = self._fly_past_faces(walker, throughput, tally) if self.plan.faces else self._fly(walker)
        throughput = self._throughput(walker)
        self._move(walker, flight, throughput)
        aimed = [] if self.connections is None else self._connect(walker, flight, before, tally)
        self._deflect(walker, flight, aimed)
        ended = self._end(walker, flight)
        if self.plan.most_steps is not None:
            ended = self._cut(walker, ended, self.plan.most_steps, tally)
        if self.plan.shape is not None:
            ended = self._start_secondary(walker, ended, tally)
        self._keep_stream(walker, before)
        self._renew(walker, ended, rows)
        return walker

    def _throughput(self, walker: Walker) -> mi.Float:
        return walker.weight * self.scores.albedo(walker.scatterings)

    def _fly(self, walker: Walker) -> Flight:
        medium = self.geometry.medium(walker.enclosure)
        sigma = self.media.extinction(medium)
        distance = dr.select(sigma > 0, minus_log1m(walker.rng.next_float32()) / sigma, dr.inf)
        # A flight that ends within the known clearance meets no surface: no ray is traced.
        inside = walker.active & (medium != 0)
        traced = walker.active & (distance >= self.geometry.clearance(walker.origin, inside))
        hit = self.geometry.intersect(walker.origin, walker.omega, walker.enclosure, traced)
        # A lane with no surface ahead has left the tooth, whatever its enclosure is: it meets nothing and ends.
        scatters = walker.active & (distance < hit.distance) & (hit.valid | ~traced)
        meets = walker.active & ~scatters & hit.valid
        # A face lets a camera ray in, weighted, where its mirror image would be of empty space, and reflects other rays
        # by chance.
        unentered = (self.scores.order(walker.scatterings) == 0) & (medium == 0) & walker.primary
        omits = unentered if self.geometry.single else mi.Bool(False)
        met = self.boundary.meet(self.geometry, walker.omega, walker.enclosure, hit, meets, omits, walker.rng)
        arrival = []
        if self.boundary.bends:
            # The highlight, which a camera ray that has entered nothing sees, is left out.
            arrival = [Arrival(walker.omega, self._throughput(walker), meets & hit.outer & ~unentered)]
        walker.weight *= met.weight
        return Flight(
            medium, sigma, hit, distance, scatters, meets, met.reflects, meets & hit.opaque, met.onward,
            met.roughness_score, arrival,
        )  # fmt: skip

    def _fly_past_faces(self, walker: Walker, throughput: mi.Float, tally: Tally) -> Flight:
        medium = self.geometry.medium(walker.enclosure)
        sigma = self.media.extinction(medium)
        hit = self.geometry.intersect(walker.origin, walker.omega, walker.enclosure, walker.active)
        leaving = hit.valid & hit.outer
        assert isinstance(self.boundary, FlatBoundary)
        through = 1 - self.boundary.reflectance_inside(dr.abs(dr.dot(walker.omega, hit.normal)))

        # Count the share that leaves through an outer face.
        collides = one_minus_exp(sigma * hit.distance)
        face = dr.select(walker.omega.z > 0, mi.UInt32(1), mi.UInt32(0))
        value = throughput * (1 - collides) * through
        lengths = {k: dr.select(medium == k, hit.distance, 0) for k in self.scores.sigma_media}
        primary = walker.active & leaving & walker.primary
        tally.add(walker.row, face, value, primary)
        if self.exits is not None:
            self.exits.count_ring(walker, self.scores.order(walker.scatterings), hit, face, value, tally)
            self.exits.connect(
                walker, hit, sigma, throughput * dr.exp(self.media.pick(self.media.log_alpha, medium)), tally
            )
        for which, score in enumerate(self.scores.complete(walker.sums, walker.scatterings, mi.UInt32(0), {}, lengths)):
            tally.add_derivative(which, walker.row, face, value * score, primary)
        for mode in range(self.modes):
            factor = dr.select(walker.primary, walker.border_sums[mode], walker.shape_factor[mode])
            tally.add_derivative(
                len(self.plan.scores) + mode, walker.row, face, value * factor, walker.active & leaving
            )

        # The rest collides before the face or is reflected by it.
        remains = dr.select(leaving, collides + (1 - collides) * (1 - through), 1)
        reflects = leaving & (walker.rng.next_float32() * remains >= collides)
        distance = minus_log1m(walker.rng.next_float32() * dr.select(leaving, collides, 1)) / sigma
        scatters = walker.active & dr.select(leaving, ~reflects, distance < hit.distance)
        distance = dr.select(leaving, dr.minimum(distance, hit.distance), distance)
        first = scatters & (self.scores.order(walker.scatterings) == 0) & walker.primary
        walker.weight *= remains
        # Compare roulette with the weight after one scattering, so that single scattering survives at any albedo.
        walker.reference = dr.select(
            first, walker.weight * dr.exp(self.media.pick(self.media.log_alpha, medium)), walker.reference
        )
        image = walker.omega - mi.Vector3f(hit.normal) * (2 * dr.dot(walker.omega, hit.normal))
        return Flight(
            medium, sigma, hit, distance, scatters, walker.active & ~scatters & hit.valid, reflects, mi.Bool(False),
            dr.select(reflects, image, walker.omega), mi.Float(0),
        )  # fmt: skip

    def _move(self, walker: Walker, flight: Flight, throughput: mi.Float) -> None:
        hit, omega = flight.hit, walker.omega
        length = dr.select(flight.scatters, flight.distance, dr.select(flight.meets, hit.distance, 0))
        walker.sums = self.scores.flight(walker.sums, flight.medium, length, flight.scatters)
        crosses = flight.meets & ~flight.reflects & ~flight.bounces
        behind = self.geometry.beyond(walker.enclosure, omega, hit)
        cosine = dr.dot(omega, hit.normal)
        if self.plan.shape is not None:
            # Score the border's transmittance change, and offer the crossing for the scattering change.
            shifts = [speed * inverse_cosine(cosine) for speed in self.geometry.velocity(hit, self.plan.shape, crosses)]
            jump = dr.select(crosses, self.media.extinction(self.geometry.medium(behind)) - flight.sigma, 0)
            walker.border_sums = [
                dr.fma(jump, shift, total) for shift, total in zip(shifts, walker.border_sums, strict=True)
            ]
            at_border = crosses & ~hit.outer & walker.primary
            u = walker.rng.next_float32()
            crossing_point = dr.fma(omega, hit.distance, walker.origin)
            walker.border_crossing = [
                offer(kept, crossing_point, omega, hit, walker.enclosure, behind, throughput, shifts, u, at_border)
                for kept in walker.border_crossing
            ]
        if self.geometry.stained:
            stained = crosses & self.geometry.on_stain(hit, walker.enclosure, behind)
            walker.weight *= self.geometry.stain(hit, stained)
            walker.stains = [reservoir.offer(hit, stained) for reservoir in walker.stains]
        reached = self.geometry.advance(walker.origin, omega, hit, crosses)
        walker.origin = dr.select(
            flight.scatters,
            dr.fma(omega, flight.distance, walker.origin),
            dr.select(flight.meets, reached, walker.origin),
        )
        walker.omega = dr.select(flight.meets, flight.onward, omega)
        walker.enclosure = dr.select(crosses, behind, walker.enclosure)
        scattered_in = flight.medium
        if self.geometry.opaque:
            scattered_in = dr.select(flight.bounces, mi.UInt32(self.media.count), flight.medium)
        walker.scatterings = self.scores.scatter(walker.scatterings, scattered_in, flight.scatters | flight.bounces)

    def _connect(self, walker: Walker, flight: Flight, before: mi.UInt64, tally: Tally) -> list[mi.Bool]:
        """Offer vertices to the lane's reservoirs, and connect what these hold where that is due; returns from which
        lanes connections are aimed.
        """
        assert self.connections is not None and walker.vertex is not None  # noqa: PT018
        throughput, rng = self._throughput(walker), walker.rng
        vertex, offered = self.connections.found(walker, flight, throughput)
        walker.vertex = self.connections.offer(walker.vertex, vertex, rng.next_float32(), offered)
        aimed = []
        for aiming in self.aiming:
            vertex, offered = aiming.found(walker, flight, throughput)
            aimed.append(offered)
            walker.aimed = [aiming.offer(walker.aimed[0], vertex, rng.next_float32(), offered)]
        self._keep_stream(walker, before)
        walker.connection_step += 1
        for aiming in self.aiming:
            due = walker.working & (walker.connection_step % aiming.period == 0) & (walker.aimed[0].total > 0)
            walker.rng = aiming.connect(walker.aimed[0], walker.row, walker.rng, due, tally)
            walker.aimed[0].total = dr.select(due, 0, walker.aimed[0].total)
        due = walker.working & (walker.connection_step == self.connections.period) & (walker.vertex.total > 0)
        walker.rng = self.connections.connect(walker.vertex, walker.row, walker.rng, due, tally)
        walker.vertex.total = dr.select(due, 0, walker.vertex.total)
        walker.connection_step = dr.select(walker.connection_step == self.connections.period, 0, walker.connection_step)
        return aimed

    def _deflect(self, walker: Walker, flight: Flight, aimed: list[mi.Bool]) -> None:
        phase, rng = PhaseFunction(self.media, flight.medium), walker.rng
        u_lobe = rng.next_float32() if self.media.two_lobes else None
        u, v = rng.next_float32(), rng.next_float32()
        onward = phase.sample(walker.omega, u_lobe, u, v)
        walker.sums = self.scores.deflection(
            walker.sums, flight.medium, phase.scores(self.scores.phase_fields, walker.omega, onward), flight.scatters
        )
        walker.sums = self.scores.boundary(walker.sums, flight.roughness_score)
        if self.geometry.opaque:
            diffuse = mi.Frame3f(facing(walker.omega, flight.hit)).to_world(
                mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v))
            )
            walker.omega = dr.select(flight.bounces, diffuse, walker.omega)
        if walker.leg:
            turns = flight.scatters | (flight.meets & flight.hit.outer)
            leg = Leg(walker.origin, walker.omega, flight.medium, *aimed)
            walker.leg = [dr.select(turns, leg, walker.leg[0])]
        walker.omega = dr.select(flight.scatters, onward, walker.omega)

    def _end(self, walker: Walker, flight: Flight) -> mi.Bool:
        # Let faded paths survive in proportion to their throughput; end those that met nothing.
        share = self._throughput(walker) / (ROULETTE_WEIGHT * walker.reference)
        faded = (share < 1) & (walker.rng.next_float32() >= share)
        walker.weight *= dr.select(share < 1, dr.rcp(dr.maximum(share, 1e-20)), 1)
        ended = walker.active & ((~flight.scatters & ~flight.meets) | faded)
        if self.plan.order_edges:
            ended |= walker.active & (self.scores.order(walker.scatterings) >= self.plan.order_edges[-1])
        return ended

    def _cut(self, walker: Walker, ended: mi.Bool, most_steps: int, tally: Tally) -> mi.Bool:
        """End paths that took their last step, and count the throughput that they still carried."""
        walker.steps = [count + 1 for count in walker.steps]
        cut = walker.active & ~ended & (walker.steps[0] >= most_steps)
        if self.plan.faces:
            tally.add(walker.row, mi.UInt32(2), self._throughput(walker), cut & walker.primary)
        return ended | cut

    def _start_secondary(self, walker: Walker, ended: mi.Bool, tally: Tally) -> mi.Bool:
        """Start the kept crossing's secondary walk where paths ended; returns the lanes that are wholly finished."""
        begins = ended & walker.primary & (walker.border_crossing[0].total > 0)

        def begin(walker: Walker, begins: mi.Bool) -> Walker:
            crossing, rng = walker.border_crossing[0], walker.rng
            scattering = BorderScattering(self.geometry, self.media, crossing)
            size = sum((dr.abs(shift) for shift in crossing.shifts), start=mi.Float(0))
            strength = crossing.throughput * crossing.total / crossing.importance * size
            ratios = [shift / size for shift in crossing.shifts]

            # Add the light that the border point scatters directly.
            if self.lights is not None:
                chosen = self.lights.choose(crossing.point, scattering, rng, begins)
                point, enclosure = scattering.point(chosen.direction), scattering.enclosure(chosen.direction)
                ray = shadow(
                    self.geometry, self.media, point, chosen.direction, enclosure, begins, boundary=self.boundary
                )
                value = strength * chosen.total * scattering.balance(chosen.direction) * ray.transmittance()
                for mode, ratio in enumerate(ratios):
                    tally.add_derivative(len(self.plan.scores) + mode, walker.row, chosen.index, value * ratio, begins)

            # Start one walk for the lobes of both sides, which carries their signed difference.
            u_lobe = rng.next_float32() if self.media.two_lobes else None
            omega = scattering.sample(rng.next_float32(), u_lobe, rng.next_float32(), rng.next_float32())
            balance = scattering.balance(omega)
            walker.origin, walker.enclosure, walker.omega = scattering.point(omega), scattering.enclosure(omega), omega
            walker.weight = strength * (scattering.sigma_a + scattering.sigma_b) * dr.abs(balance)
            walker.reference = mi.Float(walker.weight)
            walker.shape_factor = [dr.mulsign(ratio, balance) for ratio in ratios]
            walker.scatterings = self.scores.unscattered()
            walker.steps = [dr.zeros(mi.UInt32) for _ in walker.steps]
            walker.secondary = [mi.Bool(True)]
            walker.rng = rng
            return walker

        walker_after = dr.if_stmt((walker, begins), begins, begin, lambda walker, _: walker, label="secondary walk")
        for field in (
            "rng",
            "origin",
            "omega",
            "enclosure",
            "weight",
            "reference",
            "scatterings",
            "steps",
            "secondary",
            "shape_factor",
        ):
            setattr(walker, field, getattr(walker_after, field))
        return (ended & ~begins) | (begins & (walker.weight == 0))

    def _keep_stream(self, walker: Walker, before: mi.UInt64) -> None:
        """Restore the random numbers of lanes without a path. Their row's last connection takes the first ones that
        follow the row's paths, however long a lane waits for it.
        """
        walker.rng.state = dr.select(walker.active, walker.rng.state, before)

    def _renew(self, walker: Walker, ended: mi.Bool, rows: Rows) -> None:
        """Put the row's next sample in place of finished paths, and another row in place of finished rows.

        A lane whose row is finished waits for the step at which all lanes connect, as its row's last vertex is to be
        connected first. So every row begins at the same step of that cycle, and its sums are the same whichever lane
        walks it, and whatever that lane walked before.
        """
        idle = walker.working & (~walker.active | (ended & (walker.sample + 1 == rows.samples)))
        takes = idle & (walker.connection_step == 0)

        def renew(walker: Walker, begins: mi.Bool, takes: mi.Bool) -> Walker:
            walker.row = dr.select(takes, rows.take(walker.row, takes), walker.row)
            walker.sample = dr.select(takes, 0, walker.sample + 1)
            walker.working = ~takes | (walker.row < rows.count)
            path = self.start.begin(walker.row, walker.sample, begins & walker.working)
            walker.rng, walker.origin = path.rng, path.origin
            walker.omega, walker.enclosure = path.omega, path.enclosure
            walker.weight, walker.reference = path.weight, mi.Float(path.weight)
            walker.scatterings = self.scores.unscattered()
            walker.steps = [mi.UInt32(0) for _ in walker.steps]
            walker.sums = [mi.Float(0) for _ in walker.sums]
            walker.border_sums = [mi.Float(0) for _ in walker.border_sums]
            for crossing in walker.border_crossing:
                crossing.total = mi.Float(0)
            for leg in walker.leg:
                leg.scattered = mi.Bool(False)
            walker.stains = [FaceCrossing.none(walker.rng.next_float32()) for _ in walker.stains]
            walker.secondary = [mi.Bool(False) for _ in walker.secondary]
            walker.active = walker.working & (walker.sample < rows.samples)
            return walker

        begins = ended | takes
        renewed = dr.if_stmt((walker, begins, takes), begins, renew, lambda walker, _b, _t: walker, label="next sample")
        vars(walker).update(vars(renewed))
