"""Where a walk's contributions land: private slots per lane, so that sums never depend on the order of threads."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


class Tally:
    """Sums of contributions and of contributions times scores, per (lane, slot); a slot is a light, or a light's order bin."""

    def __init__(self, lanes: int, slots: int, derivatives: int) -> None:
        self.lanes, self.slots = lanes, slots
        self.sums = dr.zeros(mi.Float, lanes * slots)
        self.derivatives = [dr.zeros(mi.Float, lanes * slots) for _ in range(derivatives)]
        dr.make_opaque(self.sums, self.derivatives)

    def add(self, lane: mi.UInt32, slot: mi.UInt32, value: mi.Float, active: mi.Bool) -> None:
        """Add to a light's sum."""
        dr.scatter_add(self.sums, value, lane * self.slots + slot, active, mode=dr.ReduceMode.NoConflicts)

    def add_derivative(self, which: int, lane: mi.UInt32, slot: mi.UInt32, value: mi.Float, active: mi.Bool) -> None:
        """Add to a derivative's sum."""
        dr.scatter_add(self.derivatives[which], value, lane * self.slots + slot, active, mode=dr.ReduceMode.NoConflicts)

    def evaluate(self) -> None:
        """Run the kernel without holding the interpreter: a worker's heartbeat goes on."""
        dr.eval(self.sums, self.derivatives)
        dr.sync_thread()

    def arrays(self) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Sums and derivative sums as (lanes, slots) float64."""
        shape = (self.lanes, self.slots)
        return np.array(self.sums, dtype=np.float64).reshape(shape), [np.array(d, dtype=np.float64).reshape(shape) for d in self.derivatives]
