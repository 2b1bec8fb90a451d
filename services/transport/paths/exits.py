"""Places and directions in which scattered light leaves a slab: rings about the point of entry, radiance at chosen
cosines.

Every flight is connected to every exit cosine by the mean over its possible collisions, along one random azimuth, the
same for all cosines: on a straight flight in one layer the phase function towards an exit is constant and the
transmittance an integral of exponentials, so neither the place of the collision nor a grazing exit adds noise. Light
that partly reflecting faces send to and fro on its way out is summed as a geometric series.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from services.transport.boundary.model import FlatBoundary
from services.transport.optics.free_flight import one_minus_exp
from services.transport.paths.scores import Plan
from services.transport.paths.tally import Tally
from services.transport.paths.walker import Walker
from services.transport.scene.geometry import Hit, SlabGeometry
from services.transport.scene.media import Media, PhaseFunction

MIN_RATE = 1e-6
"""Smallest rate of attenuation along flight and way out together, per optical depth flown. Closer to 0 than this the
two cancel, and the integrand is constant."""


class Exits:
    """Exit slots of a tally, from ``first_slot`` on: lit and far face for every cosine, then for every ring."""

    def __init__(
        self, geometry: SlabGeometry, media: Media, plan: Plan, boundary: FlatBoundary, first_slot: int
    ) -> None:
        self.geometry, self.media, self.plan, self.boundary = geometry, media, plan, boundary
        self.cosines, self.edges_mm = (
            mi.Float(np.array(values, dtype=np.float32)) for values in (plan.exit_cosines, plan.ring_edges_mm)
        )
        dr.eval(self.cosines, self.edges_mm)
        self._first_cosine, self._first_ring = first_slot, first_slot + 2 * len(plan.exit_cosines)
        self.slots = 2 * (len(plan.exit_cosines) + plan.rings)

    def count_ring(
        self, walker: Walker, order: mi.UInt32, hit: Hit, face: mi.UInt32, value: mi.Float, tally: Tally
    ) -> None:
        """Count ``value``, light that leaves through the face ahead after ``order`` scatterings, in the ring of its
        exit point; unscattered light is left out.
        """
        if not self.plan.rings:
            return
        radius = dr.hypot(
            dr.fma(walker.omega.x, hit.distance, walker.origin.x), dr.fma(walker.omega.y, hit.distance, walker.origin.y)
        )
        ring = mi.UInt32(0)
        for edge in range(len(self.plan.ring_edges_mm)):
            ring += dr.select(radius >= dr.gather(mi.Float, self.edges_mm, edge), mi.UInt32(1), mi.UInt32(0))
        scattered = walker.active & hit.valid & hit.outer & (order > 0) & walker.primary
        tally.add(walker.row, self._first_ring + 2 * ring + face, value, scattered)

    def connect(self, walker: Walker, hit: Hit, sigma: mi.Float, scattered: mi.Float, tally: Tally) -> None:
        """Add to the radiance at every cosine the light that collisions on the flight ahead scatter there;
        ``scattered`` is the throughput after one collision.
        """
        if not self.plan.exit_cosines:
            return
        phase = PhaseFunction(self.media, self.geometry.medium(walker.enclosure))
        azimuth = dr.sincos(2 * dr.pi * walker.rng.next_float32())
        begin = mi.Vector2f(*self.geometry.depths(walker.origin.z, self.media.sigma))
        landing = dr.select(hit.valid, dr.fma(walker.omega.z, hit.distance, walker.origin.z), walker.origin.z)
        end = mi.Vector2f(*self.geometry.depths(landing, self.media.sigma))
        optical_depth, active = sigma * hit.distance, walker.active & walker.primary

        def step(
            which: mi.UInt32, omega: mi.Vector3f, across: mi.Vector2f, begin: mi.Vector2f, end: mi.Vector2f,
            optical_depth: mi.Float, scattered: mi.Float, row: mi.UInt32, active: mi.Bool,
        ) -> tuple[mi.UInt32, mi.Vector3f, mi.Vector2f, mi.Vector2f, mi.Vector2f, mi.Float, mi.Float, mi.UInt32,
                   mi.Bool]:  # fmt: skip
            inside, narrowing, mirrored = self.boundary.leave(dr.gather(mi.Float, self.cosines, which, active))
            sine = dr.sqrt(dr.maximum(1 - dr.square(inside), 0))
            contributions = []
            for side, sign in enumerate((-1, 1)):
                # Collisions have density exp(-depth flown), and their light leaves with transmittance exp(-depth to the
                # face / cosine).
                rate = 1 + (-sign / inside) * omega.z
                size = dr.maximum(dr.abs(rate), MIN_RATE)
                brightest = dr.select(rate > 0, begin[side] / inside, end[side] / inside + optical_depth)
                chance = dr.exp(-brightest) * one_minus_exp(size * optical_depth) / size
                contributions.append(
                    chance * phase.density(omega, mi.Vector3f(across.x * sine, across.y * sine, sign * inside))
                )

            # Light that a face reflects back crosses the slab to the other face, and so on.
            back = mirrored * dr.exp(-(begin.x + begin.y) / inside)
            strength = scattered * (1 - mirrored) / (narrowing * inside * (1 - dr.square(back)))
            slot = self._first_cosine + 2 * which
            tally.add(row, slot, strength * dr.fma(contributions[1], back, contributions[0]), active)
            tally.add(row, slot + 1, strength * dr.fma(contributions[0], back, contributions[1]), active)
            return which + 1, omega, across, begin, end, optical_depth, scattered, row, active

        state = (
            mi.UInt32(0),
            walker.omega,
            mi.Vector2f(azimuth[1], azimuth[0]),
            begin,
            end,
            optical_depth,
            scattered,
            walker.row,
            active,
        )
        dr.while_loop(
            state,
            lambda which, *others: others[-1] & (which < len(self.plan.exit_cosines)),
            step,
            label="every exit cosine",
        )
