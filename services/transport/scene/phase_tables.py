"""Tabulated phase functions in a kernel, evaluated and sampled as ``optics.phase_table`` defines them."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.transport.optics import phase
from services.transport.optics.phase_table import PhaseTable

ISOTROPIC = PhaseTable((0.0, np.pi), (1.0, 1.0))
"""Placeholder for a medium that has no table."""
NEARLY_ONE = 1 - 2.0**-24
"""Largest float32 number below 1."""
MIN_WIDTH = 1e-30
"""Smallest width of an interval as a divisor, because nodes may coincide in single precision."""


class PhaseTables:
    """The tables of media 1..M side by side, each as its forward and its backward half."""

    def __init__(self, tables: Sequence[PhaseTable | None]) -> None:
        halves = [(table or ISOTROPIC).hemisphere(back=back) for table in tables for back in (False, True)]
        lengths = [len(half.deviations) for half in halves]
        self._count, self._longest = len(tables), max(lengths)

        def joined(columns: list[NDArray[np.float64]]) -> mi.Float:
            return mi.Float(np.concatenate(columns).astype(np.float32))

        self._known = mi.Bool([table is not None for table in tables])
        self._first = mi.UInt32(np.cumsum([0, *lengths[:-1]]).astype(np.uint32))
        self._bins = mi.UInt32(np.array(lengths, dtype=np.uint32) - 1)
        self._forward = mi.Float([half.share for half in halves[::2]])
        self._deviations = joined([half.deviations for half in halves])
        self._values = joined([half.values for half in halves])
        self._cumulative = joined([half.cumulative for half in halves])
        dr.eval(self._known, self._first, self._bins, self._forward, self._deviations, self._values, self._cumulative)

    def known(self, medium: mi.UInt32) -> mi.Bool:
        """Whether the medium has a table; empty space gives the answer of the last medium."""
        return dr.gather(mi.Bool, self._known, self._index(medium))

    def density(self, medium: mi.UInt32, omega: mi.Vector3f, omega_out: mi.Vector3f) -> mi.Float:
        """Value of the phase function, 1/sr."""
        sign = dr.mulsign(mi.Float(1), dr.dot(omega, omega_out))
        m = phase.deviation(sign, omega, omega_out)
        node = self._last_not_above(self._deviations, self._half(medium, sign < 0), m)
        (m0, m1), (p0, p1) = self._ends(self._deviations, node), self._ends(self._values, node)
        return dr.lerp(p0, p1, dr.clip((m - m0) / dr.maximum(m1 - m0, MIN_WIDTH), 0, 1))

    def sample(self, medium: mi.UInt32, omega: mi.Vector3f, u: mi.Float, v: mi.Float) -> mi.Vector3f:
        """Direction distributed as the table, by inversion of its distribution function."""
        # Choose the half, the interval between nodes and the position in it, each from the remainder of one random
        # number.
        forward = dr.gather(mi.Float, self._forward, self._index(medium))
        back = u >= forward
        u = dr.clip(dr.select(back, (u - forward) / (1 - forward), u / forward), 0, NEARLY_ONE)
        node = self._last_not_above(self._cumulative, self._half(medium, back), u)
        c0, c1 = self._ends(self._cumulative, node)
        u = dr.clip((u - c0) / (c1 - c0), 0, 1)

        # Linear density: (p0 + p1) u = 2 p0 t + (p1 - p0) t^2, without cancellation and relative to the larger end.
        (m0, m1), (p0, p1) = self._ends(self._deviations, node), self._ends(self._values, node)
        larger = dr.maximum(p0, p1)
        p0, p1 = p0 / larger, p1 / larger
        t = u * (p0 + p1) / dr.maximum(p0 + dr.sqrt(dr.lerp(dr.square(p0), dr.square(p1), u)), 1e-20)
        return phase.deflected(omega, dr.select(back, mi.Float(-1), mi.Float(1)), dr.lerp(m0, m1, t), v)

    def _index(self, medium: mi.UInt32) -> mi.UInt32:
        return dr.select(medium == 0, self._count, medium) - 1

    def _half(self, medium: mi.UInt32, back: mi.Bool) -> mi.UInt32:
        return 2 * self._index(medium) + dr.select(back, mi.UInt32(1), mi.UInt32(0))

    def _last_not_above(self, column: mi.Float, half: mi.UInt32, value: mi.Float) -> mi.UInt32:
        """Index of the node that begins the interval of a half in which ``value`` lies."""
        first, bins = dr.gather(mi.UInt32, self._first, half), dr.gather(mi.UInt32, self._bins, half)
        last = first + bins - 1

        def not_above(k: mi.UInt32) -> mi.Bool:
            return (first + k <= last) & (dr.gather(mi.Float, column, dr.minimum(first + k, last)) <= value)

        return first + dr.maximum(dr.binary_search(0, self._longest, not_above), 1) - 1

    @staticmethod
    def _ends(column: mi.Float, node: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        return dr.gather(mi.Float, column, node), dr.gather(mi.Float, column, node + 1)
