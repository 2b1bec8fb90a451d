"""The moving border between two media: the second term of the derivative to the dentin's shape (optics.md).

Along a path, each crossing of the border at x_b from medium A into B contributes

    dt_b * throughput * [ (sigma_s,A S_A - sigma_s,B S_B) - (sigma_A - sigma_B) L_forward ]

with dt_b = (v . n) / (omega . n). The last part is an ordinary score of all that the path gathers later. The first part
needs the radiance scattered into omega at x_b under either medium's phase function: one crossing per path is kept by
reservoir sampling, and a secondary walk starts there. Eq. 32 of teeth 2018 has only the last part.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from services.transport.scene.geometry import Geometry, Hit
from services.transport.scene.media import Media, PhaseFunction

COSINE_CLAMP = 1e-3
"""Smallest |omega . n| in 1/|omega . n|, whose second moment diverges logarithmically. Crossings at cosine mu come with
density ~ mu, so the clamp removes about half of this value, 5e-4, of a one-sided term that its partner nearly
cancels."""


def inverse_cosine(cosine: mi.Float) -> mi.Float:
    """1 / cosine, with |cosine| clamped to at least ``COSINE_CLAMP``."""
    return dr.mulsign(dr.rcp(dr.maximum(dr.abs(cosine), COSINE_CLAMP)), cosine)


@dataclass
class Crossing:
    """One border crossing of each lane's path, kept by reservoir sampling."""

    point: mi.Point3f
    omega: mi.Vector3f
    """Propagation direction of the path."""
    normal: mi.Vector3f
    before: mi.UInt32
    """Place on the side from which the path came."""
    after: mi.UInt32
    """Place on the other side."""
    throughput: mi.Float
    """Throughput of the path up to the crossing, albedos included."""
    shifts: list[mi.Float]
    """dt_b of each shape mode."""
    importance: mi.Float
    """Importance of the kept crossing."""
    total: mi.Float
    """Sum of the importance of all crossings of the path; 0 when there was none."""


def no_crossing(modes: int) -> Crossing:
    """An empty reservoir."""
    return Crossing(
        mi.Point3f(0),
        mi.Vector3f(0, 0, 1),
        mi.Vector3f(0, 0, 1),
        mi.UInt32(0),
        mi.UInt32(0),
        mi.Float(0),
        [mi.Float(0) for _ in range(modes)],
        mi.Float(0),
        mi.Float(0),
    )


def offer(
    reservoir: Crossing,
    point: mi.Point3f,
    omega: mi.Vector3f,
    hit: Hit,
    before: mi.UInt32,
    after: mi.UInt32,
    throughput: mi.Float,
    shifts: list[mi.Float],
    u: mi.Float,
    active: mi.Bool,
) -> Crossing:
    """Offer a crossing to the reservoir, importance = throughput x sum |dt_b|."""
    importance = mi.Float(0)
    for shift in shifts:
        importance += dr.abs(shift)
    importance = dr.select(active, importance * throughput, 0)
    total = reservoir.total + importance
    take = active & (u * total < importance)
    select = dr.select
    return Crossing(
        select(take, point, reservoir.point),
        select(take, omega, reservoir.omega),
        select(take, mi.Vector3f(hit.normal), reservoir.normal),
        select(take, before, reservoir.before),
        select(take, after, reservoir.after),
        select(take, throughput, reservoir.throughput),
        [select(take, new, old) for new, old in zip(shifts, reservoir.shifts, strict=True)],
        select(take, importance, reservoir.importance),
        total,
    )


class BorderScattering:
    """(sigma_s,A f_A - sigma_s,B f_B) at a kept crossing, and directions sampled from the two lobes together."""

    def __init__(self, geometry: Geometry, media: Media, crossing: Crossing) -> None:
        self.crossing, self.geometry, self.media = crossing, geometry, media
        index_a, index_b = geometry.medium(crossing.before), geometry.medium(crossing.after)
        self.phase_a, self.phase_b = PhaseFunction(media, index_a), PhaseFunction(media, index_b)
        self.sigma_a, self.sigma_b = (
            dr.select(index == 0, 0, media.pick(media.sigma_s, index)) for index in (index_a, index_b)
        )

    def __call__(self, direction: mi.Vector3f) -> mi.Float:
        """sigma_s,A f_A + sigma_s,B f_B: the importance of a light in this direction."""
        return self._sides(direction)[0] + self._sides(direction)[1]

    def balance(self, direction: mi.Vector3f) -> mi.Float:
        """(sigma_s,A f_A - sigma_s,B f_B) / (sigma_s,A f_A + sigma_s,B f_B), -1 to 1; 0 where neither side scatters."""
        a, b = self._sides(direction)
        return dr.select(a + b > 0, (a - b) / (a + b), 0)

    def _sides(self, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        omega = self.crossing.omega
        return self.sigma_a * self.phase_a.density(omega, direction), self.sigma_b * self.phase_b.density(
            omega, direction
        )

    def enclosure(self, direction: mi.Vector3f) -> mi.UInt32:
        """The side on which a walk in ``direction`` starts, by the sign of n . direction."""
        onward = dr.dot(direction, self.crossing.normal) * dr.dot(self.crossing.omega, self.crossing.normal) > 0
        return dr.select(onward, self.crossing.after, self.crossing.before)

    def point(self, direction: mi.Vector3f) -> mi.Point3f:
        """Start of a walk in ``direction``, offset off the border to its side."""
        offset = self.crossing.normal * dr.mulsign(
            mi.Float(self.geometry.epsilon), dr.dot(direction, self.crossing.normal)
        )
        return mi.Point3f(self.crossing.point + offset)

    def sample(self, u_side: mi.Float, u_lobe: mi.Float | None, u: mi.Float, v: mi.Float) -> mi.Vector3f:
        """A direction with density (sigma_s,A f_A + sigma_s,B f_B) / (sigma_s,A + sigma_s,B)."""
        from_a = self.phase_a.sample(self.crossing.omega, u_lobe, u, v)
        from_b = self.phase_b.sample(self.crossing.omega, u_lobe, u, v)
        return dr.select(u_side * (self.sigma_a + self.sigma_b) < self.sigma_a, from_a, from_b)
