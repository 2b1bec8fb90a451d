"""The rows of a tally as work for the lanes of a kernel: a lane that has finished one row takes another."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class Rows:
    """Rows of equal numbers of paths, and the queue from which lanes take them.

    Some paths scatter a hundred times as often as others. With one row for each lane, a vector unit runs until the
    longest of its rows is finished, and most of its lanes have nothing to do meanwhile. So lanes take rows from a
    common queue, in the order of the rows. Which lane walks a row depends on the timing of threads; the sums of a row
    must not depend on it.
    """

    def __init__(self, count: int, samples: int, *, fixed: bool) -> None:
        """Take the number of rows, and of paths in each.

        Args:
            fixed: lane k walks row k alone, because media or layers differ from lane to lane.
        """
        self._lanes = count
        # A graphics card has work for as many lanes as there are rows, and there the queue has not been tried.
        self._fixed = fixed or dr.backend_v(mi.Float) == dr.JitBackend.CUDA
        self.count, self.samples = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, samples)
        self._taken = dr.opaque(mi.UInt32, 0)

    def lanes(self) -> mi.Bool:
        """True for each of the kernel's lanes, one per row. Lanes that find the queue empty end at once."""
        return dr.arange(mi.UInt32, self._lanes) < self.count

    def before_first(self) -> mi.UInt32:
        """Row of each lane before it takes its first one."""
        return dr.arange(mi.UInt32, self._lanes) - self.count

    def take(self, row: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The next row for lanes that have finished ``row``; ``count`` or more where no row is left."""
        if self._fixed:
            return row + self.count
        return dr.scatter_inc(self._taken, mi.UInt32(0), active)
