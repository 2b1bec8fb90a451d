"""Sums of a walk's contributions by row. One lane walks a row at a time, so sums never depend on the order of threads.

Sums are in double precision: in single precision, a row that adds ten thousand nearly equal numbers is off by 1e-5,
with the same sign each time.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


class Tally:
    """Sums of contributions and of contributions times scores, per (row, slot). A slot is a light, or a bin of
    scattering order under a light.
    """

    def __init__(self, rows: int, slots: int, derivatives: int) -> None:
        self.rows, self.slots = rows, slots
        self.sums = dr.zeros(mi.Float64, rows * slots)
        self.derivatives = [dr.zeros(mi.Float64, rows * slots) for _ in range(derivatives)]
        dr.make_opaque(self.sums, self.derivatives)

    def add(self, row: mi.UInt32, slot: mi.UInt32, value: mi.Float, active: mi.Bool) -> None:
        """Add a contribution to a slot's sum."""
        dr.scatter_add(self.sums, mi.Float64(value), row * self.slots + slot, active, mode=dr.ReduceMode.NoConflicts)

    def add_derivative(self, which: int, row: mi.UInt32, slot: mi.UInt32, value: mi.Float, active: mi.Bool) -> None:
        """Add a contribution times score to a slot's sum of derivative ``which``."""
        dr.scatter_add(
            self.derivatives[which], mi.Float64(value), row * self.slots + slot, active, mode=dr.ReduceMode.NoConflicts
        )

    def evaluate(self) -> None:
        """Run the kernel without holding the interpreter lock, so that a worker's heartbeat goes on."""
        dr.eval(self.sums, self.derivatives)
        dr.sync_thread()

    def arrays(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Sums and derivative sums as (rows, slots) float64."""
        shape = (self.rows, self.slots)
        return np.array(self.sums).reshape(shape), [np.array(d).reshape(shape) for d in self.derivatives]
