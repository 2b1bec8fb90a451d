"""The random walk specialised by hand to the simplest tooth: one medium of one lobe, index-matched, images only.

Starts, ray tracing, connections to lights, sums and the order of paths are the engine's own; the steps of a path are
written here without any options. The engine's kernel for such a scene must be no larger than this one, and its images
equal to the last bit.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from services.transport.engine import Engine
from services.transport.lighting.lights import PointLights
from services.transport.optics.free_flight import minus_log1m
from services.transport.paths.rows import Rows
from services.transport.paths.scores import Plan
from services.transport.paths.starts import CameraStart
from services.transport.paths.tally import Tally
from services.transport.paths.walk import ROULETTE_WEIGHT, Walk
from services.transport.paths.walker import Flight, Walker
from services.transport.scene.media import Media, PhaseFunction


class PlainEngine(Engine):
    """An engine whose images come from the plain walk; only for scenes of the simplest kind."""

    def _walk(self, media: Media, lights: PointLights, start: CameraStart, plan: Plan) -> Walk:
        assert media.count == 1
        assert not media.two_lobes
        assert self._boundary.unaltered
        assert plan == Plan()
        return PlainWalk(self._geometry, media, lights, start, plan, self._boundary)


class PlainWalk(Walk):
    """Walk of free flights, crossings of the surface, connections to lights, scattering and Russian roulette; it uses
    only the part of a walker's state that these need.
    """

    def _step(self, walker: Walker, tally: Tally, rows: Rows) -> Walker:
        # Fly to the next scattering or to the surface.
        geometry, before = self.geometry, mi.UInt64(walker.rng.state)
        medium = walker.enclosure & 1
        sigma = dr.select(medium == 0, 0, self.media.sigma[0])
        distance = dr.select(sigma > 0, minus_log1m(walker.rng.next_float32()) / sigma, dr.inf)
        traced = walker.active & (distance >= geometry.clearance(walker.origin, walker.active & (medium != 0)))
        hit = geometry.intersect(walker.origin, walker.omega, walker.enclosure, traced)
        scatters = walker.active & (distance < hit.distance) & (hit.valid | ~traced)
        crosses = walker.active & ~scatters & hit.valid
        beyond = geometry.advance(walker.origin, walker.omega, hit, crosses)
        walker.origin = dr.select(
            scatters, dr.fma(walker.omega, distance, walker.origin), dr.select(crosses, beyond, walker.origin)
        )
        walker.enclosure = dr.select(crosses, geometry.beyond(walker.enclosure, walker.omega, hit), walker.enclosure)
        (count,) = walker.scatterings.counts
        walker.scatterings.counts = [dr.select(scatters & (medium == 1), count + 1, count)]

        # Connect to the lights, then sample a new direction.
        none = mi.Bool(False)
        flight = Flight(medium, sigma, hit, distance, scatters, crosses, none, none, walker.omega, mi.Float(0))
        self._connect(walker, flight, before, tally)
        onward = PhaseFunction(self.media, medium).sample(
            walker.omega, None, walker.rng.next_float32(), walker.rng.next_float32()
        )
        walker.omega = dr.select(scatters, onward, walker.omega)

        # Russian roulette: paths of low weight survive with a probability in proportion to their weight.
        share = (
            walker.weight
            * dr.exp(mi.Float(walker.scatterings.counts[0]) * self.media.log_alpha[0])
            / (ROULETTE_WEIGHT * walker.reference)
        )
        faded = (share < 1) & (walker.rng.next_float32() >= share)
        walker.weight *= dr.select(share < 1, dr.rcp(dr.maximum(share, 1e-20)), 1)
        ended = walker.active & ((~scatters & ~crosses) | faded)
        self._keep_stream(walker, before)
        self._renew(walker, ended, rows)
        return walker
