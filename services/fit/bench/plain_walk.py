"""The walk as it would be had it never learnt anything but the plainest tooth: one medium of one lobe, index-matched, images only.

Everything around it (starts, ray tracing, connections to lights, sums) is the engine's own; what is written out here is the state
that a path carries from step to step and the operations on it. The engine's kernel for such a scene must be no larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from services.fit.transport.border import no_crossing
from services.fit.transport.engine import Engine
from services.fit.transport.lights import PointLights
from services.fit.transport.media import Media, PhaseFunction
from services.fit.transport.starts import CameraStart
from services.fit.transport.tally import Tally
from services.fit.transport.walk import ROULETTE_WEIGHT, Flight, Plan, Walk, Walker, minus_log1m


class PlainEngine(Engine):
    """An engine whose images come from the plain walk; only for scenes that need no more."""

    def _walk(self, media: Media, lights: PointLights, start: CameraStart, plan: Plan) -> Walk:
        assert media.count == 1
        assert not media.two_lobes
        assert self._ior is None
        assert plan == Plan()
        return PlainWalk(self._geometry, media, lights, start, plan, None)


@dataclass
class Path:
    """All that a path of the plain walk carries."""

    rng: mi.PCG32
    origin: mi.Point3f
    omega: mi.Vector3f
    place: mi.UInt32
    weight: mi.Float
    reference: mi.Float
    scatters: mi.UInt32
    lane: mi.UInt32
    sample: mi.UInt32
    active: mi.Bool


class PlainWalk(Walk):
    """Free flights, crossings, connections, turns and roulette, with no choice left to make."""

    def run(self, samples: int) -> Tally:
        """Trace ``samples`` paths in every lane; returns their sums, evaluated."""
        tally = Tally(self.start.lanes, self.slots, 0)
        limit, lane = dr.opaque(mi.UInt32, samples), dr.arange(mi.UInt32, self.start.lanes)
        path = self.start.begin(lane, mi.UInt32(0), mi.Bool(True))
        first = Path(
            path.rng, path.origin, path.omega, path.place, path.weight, mi.Float(path.weight), mi.UInt32(0), lane, mi.UInt32(0), lane < self.start.lanes
        )  # fmt: skip
        dr.while_loop((first,), lambda path: path.active, lambda path: (self._advance(path, tally, limit),), label="plain walk")
        tally.evaluate()
        return tally

    def _advance(self, path: Path, tally: Tally, limit: mi.UInt32) -> Path:
        # Fly to a scattering or to the surface.
        geometry = self.geometry
        medium = path.place & 1
        sigma = dr.select(medium == 0, 0, self.media.sigma[0])
        distance = dr.select(sigma > 0, minus_log1m(path.rng.next_float32()) / sigma, dr.inf)
        traced = path.active & (distance >= geometry.clearance(path.origin, path.active & (medium != 0)))
        hit = geometry.intersect(path.origin, path.omega, path.place, traced)
        scatters = path.active & (distance < hit.distance) & (hit.valid | ~traced)
        crosses = path.active & ~scatters & hit.valid
        beyond = geometry.advance(path.origin, path.omega, hit, crosses)
        path.origin = dr.select(scatters, dr.fma(path.omega, distance, path.origin), dr.select(crosses, beyond, path.origin))
        path.place = dr.select(crosses, geometry.beyond(path.place, path.omega, hit), path.place)
        path.scatters = dr.select(scatters & (medium == 1), path.scatters + 1, path.scatters)

        # Connect to the lights, then turn.
        connecting = self._as_walker(path)
        self._connect(connecting, Flight(medium, sigma, hit, distance, scatters, crosses, mi.Bool(False)), tally)
        path.rng = connecting.rng
        onward = PhaseFunction(self.media, medium).sample(path.omega, None, path.rng.next_float32(), path.rng.next_float32())
        path.omega = dr.select(scatters, onward, path.omega)

        # Faint paths survive in proportion to what they carry.
        share = path.weight * dr.exp(mi.Float(path.scatters) * self.media.log_alpha[0]) / (ROULETTE_WEIGHT * path.reference)
        faded = (share < 1) & (path.rng.next_float32() >= share)
        path.weight *= dr.select(share < 1, dr.rcp(dr.maximum(share, 1e-20)), 1)
        return self._next(path, path.active & ((~scatters & ~crosses) | faded), limit)

    def _as_walker(self, path: Path) -> Walker:
        nothing: list[mi.Float] = []
        return Walker(
            path.rng, path.origin, path.omega, path.place, path.weight, path.reference, [path.scatters], [], nothing, nothing, no_crossing(0),
            mi.Bool(False), nothing, path.lane, path.sample, path.active,
        )  # fmt: skip

    def _next(self, path: Path, ended: mi.Bool, limit: mi.UInt32) -> Path:
        def renew(path: Path, ended: mi.Bool) -> Path:
            path.sample = path.sample + 1
            fresh = self.start.begin(path.lane, path.sample, ended)
            path.rng, path.origin, path.omega, path.place = fresh.rng, fresh.origin, fresh.omega, fresh.place
            path.weight, path.reference, path.scatters = fresh.weight, mi.Float(fresh.weight), mi.UInt32(0)
            path.active = path.sample < limit
            return path

        return dr.if_stmt((path, ended), ended, renew, lambda path, _: path, label="next sample")
