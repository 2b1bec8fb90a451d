"""The plan of what a kernel computes, and the scores that turn its paths into derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from services.core.errors import InputError
from services.transport.scene.media import Media, Score

MAX_COUNTED = 3
"""Largest number of media for each of which a kernel counts the scatterings separately."""


@dataclass(frozen=True)
class Plan:
    """Quantities that one kernel computes; all of them are chosen before compilation."""

    scores: tuple[Score, ...] = ()
    shape: int | None = None
    """Index of the tooth to whose dentin shape modes derivatives are computed; they follow those of ``scores`` in the
    tally."""
    faces: bool = False
    """Count the light that leaves the slab's faces instead of connecting to lights."""
    exit_cosines: tuple[float, ...] = ()
    """With ``faces``: also the radiance that leaves at these cosines."""
    ring_edges_mm: tuple[float, ...] = ()
    """With ``faces``: also the light that leaves within rings about the point of entry, between these radii and beyond
    the last."""
    order_edges: tuple[int, ...] = ()
    """Split images by scattering order at these edges."""
    stains: bool = False
    """Instead of images, compute the derivative of their sum, weighted by a cotangent, with respect to the texels of
    stains."""
    most_steps: int | None = None
    """Number of flights after which a path ends, for media in which some never end; with ``faces`` the throughput of
    paths ended in this way is counted in a third slot."""

    @property
    def rings(self) -> int:
        """Number of rings, the unbounded one included."""
        return len(self.ring_edges_mm) + 1 if self.ring_edges_mm else 0


@dataclass
class Scatterings:
    """Scatterings of a path so far.

    Albedos are accumulated as logarithms, which stays exact where 1 - alpha is below float32 resolution.
    """

    counts: list[mi.UInt32]
    """Number of scatterings in each medium that is counted separately."""
    others: list[mi.Float]
    """Sum of ln alpha over all other scatterings; empty where every medium is counted separately."""
    total: list[mi.UInt32]
    """Number of all scatterings; empty likewise."""


class Scores:
    """The accumulated d ln(path contribution) / d(parameter) of each lane, only for parameters that are free."""

    def __init__(self, plan: Plan, media: Media) -> None:
        self.plan, self.media = plan, media
        self.phase_fields = frozenset(s.field for s in plan.scores) & {"beta", "g1", "g2"}
        for s in plan.scores:
            if s.field in self.phase_fields and media.tabulated[s.medium - 1]:
                raise InputError(
                    f"Medium {s.medium} has a phase table in place of lobes, and so no {s.field}; ask for other"
                    " derivatives."
                )
        self.sigma_media = tuple(sorted({s.medium for s in plan.scores if s.field == "sigma"}))
        # Where there are few media all are counted, and where there are many only those whose albedo is free.
        self.counts_all = media.count <= MAX_COUNTED
        requested = {s.medium for s in plan.scores if s.field == "alpha"}
        self.counted = tuple(range(1, media.count + 1)) if self.counts_all else tuple(sorted(requested))

    def zero(self) -> list[mi.Float]:
        """Scores of a path that has just begun."""
        return [mi.Float(0) for _ in self.plan.scores]

    def unscattered(self) -> Scatterings:
        """Scatterings of a path that has just begun."""
        rest = 0 if self.counts_all else 1
        return Scatterings([mi.UInt32(0) for _ in self.counted], [mi.Float(0)] * rest, [mi.UInt32(0)] * rest)

    def scatter(self, scatterings: Scatterings, medium: mi.UInt32, active: mi.Bool) -> Scatterings:
        """Scatterings with one more in each active lane."""
        counts = [
            dr.select(active & (medium == k), count + 1, count)
            for k, count in zip(self.counted, scatterings.counts, strict=True)
        ]
        if self.counts_all:
            return Scatterings(counts, [], [])
        elsewhere = active
        for k in self.counted:
            elsewhere &= medium != k
        others = scatterings.others[0] + dr.select(elsewhere, self.media.pick(self.media.log_alpha, medium), 0)
        return Scatterings(counts, [others], [scatterings.total[0] + dr.select(active, mi.UInt32(1), 0)])

    def albedo(self, scatterings: Scatterings) -> mi.Float:
        """Product of the albedos of all scatterings."""
        exponent = scatterings.others[0] if scatterings.others else mi.Float(0)
        for k, count in zip(self.counted, scatterings.counts, strict=True):
            exponent = dr.fma(mi.Float(count), self.media.log_alpha[k - 1], exponent)
        return dr.exp(exponent)

    def order(self, scatterings: Scatterings) -> mi.UInt32:
        """Number of scatterings."""
        if scatterings.total:
            return scatterings.total[0]
        total = scatterings.counts[0]
        for count in scatterings.counts[1:]:
            total = total + count
        return total

    def flight(self, sums: list[mi.Float], medium: mi.UInt32, length: mi.Float, scatter: mi.Bool) -> list[mi.Float]:
        """Scores after a flight of extinction at fixed albedo: -length per segment, 1/sigma per scattering (teeth 2018
        Eq. 23, corrected).
        """
        return [
            (
                dr.select(
                    medium == s.medium,
                    total + dr.select(scatter, dr.rcp(self.media.sigma[s.medium - 1]), 0) - length,
                    total,
                )
                if s.field == "sigma"
                else total
            )
            for s, total in zip(self.plan.scores, sums, strict=True)
        ]

    def deflection(
        self, sums: list[mi.Float], medium: mi.UInt32, terms: dict[str, mi.Float], active: mi.Bool
    ) -> list[mi.Float]:
        """Scores of the phase function's parameters after a change of direction: d ln f per scattering (Eq. 12, 13)."""
        return [
            dr.select(active & (medium == s.medium), total + terms[s.field], total) if s.field in terms else total
            for s, total in zip(self.plan.scores, sums, strict=True)
        ]

    def boundary(self, sums: list[mi.Float], roughness_score: mi.Float) -> list[mi.Float]:
        """Scores after an outer face."""
        return [
            total + roughness_score if s.field == "roughness" else total
            for s, total in zip(self.plan.scores, sums, strict=True)
        ]

    def complete(
        self,
        sums: list[mi.Float],
        scatterings: Scatterings,
        medium: mi.UInt32,
        terms: dict[str, mi.Float],
        lengths: dict[int, mi.Float],
    ) -> list[mi.Float]:
        """Scores of a whole path: the accumulated sums, 1/alpha per scattering (Eq. 20), and the connection's phase
        function and segments.
        """
        whole = []
        for s, total in zip(self.plan.scores, sums, strict=True):
            value = total
            if s.field == "alpha":
                value = (
                    mi.Float(scatterings.counts[self.counted.index(s.medium)]) * self.media.inverse_alpha[s.medium - 1]
                )
            elif s.field == "sigma":
                value = total - lengths.get(s.medium, mi.Float(0))
            elif s.field in terms:
                value = total + dr.select(medium == s.medium, terms[s.field], 0)
            whole.append(value)
        return whole
