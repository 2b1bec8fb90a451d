"""Lanes of the path kernel take their work from one queue: every row is walked once, and lanes stay busy to the end.
That no sum depends on which lane walks a row is shown by ``test_engine_repeats``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.transport.platform import prepare_device

if TYPE_CHECKING:
    import mitsuba as mi

ROWS = 4096
"""Number of rows of the loop below."""
LONGEST = 64
"""Steps of the loop's longest row; the mean is about 6."""


def walked(*, fixed: bool) -> tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]:
    """Number of walks of each row, and by lane the number of steps it took and the last row it walked, of a loop whose
    rows take a geometric number of steps.
    """
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.paths.rows import Rows

    lengths = np.minimum(np.random.default_rng(1).geometric(1 / 6, ROWS), LONGEST).astype(np.uint32)
    steps_of, walks, steps, last = mi.UInt32(lengths), *(dr.zeros(mi.UInt32, ROWS) for _ in range(3))
    rows, lane = Rows(ROWS, 1, fixed=fixed), dr.arange(mi.UInt32, ROWS)
    dr.make_opaque(walks, steps, last)

    def step(
        row: mi.UInt32, left: mi.UInt32, lane: mi.UInt32, working: mi.Bool
    ) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.Bool]:
        takes = working & (left == 0)
        row = dr.select(takes, rows.take(row, takes), row)
        working &= row < rows.count
        left = dr.select(takes, dr.gather(mi.UInt32, steps_of, row, working), left) - 1
        dr.scatter_add(walks, mi.UInt32(1), row, takes & working)
        dr.scatter_add(steps, mi.UInt32(1), lane, working)
        dr.scatter(last, row, lane, working)
        return row, left, lane, working

    dr.while_loop((rows.before_first(), dr.zeros(mi.UInt32, ROWS), lane, rows.lanes()), lambda *state: state[-1], step)
    dr.eval(walks, steps, last)
    return np.array(walks), np.array(steps), np.array(last)


def test_every_row_is_walked_once_and_lanes_stay_busy() -> None:
    walks, steps, _ = walked(fixed=False)
    assert (walks == 1).all()
    # A vector unit, of 4 lanes or more, runs as long as its busiest lane. Of 4 rows of 6 steps on average the longest
    # has about 12, so with one row for each lane half of the lanes would have work. With the queue a lane is without
    # work only while the last rows of its unit end: at most ``LONGEST`` steps of some 600 where two threads share the
    # rows, and a unit that comes late takes few rows or none.
    units = steps.reshape(-1, 4)
    assert steps.sum() >= 0.85 * 4 * units.max(axis=1).sum()


def test_rows_of_their_own_stay_with_their_lanes() -> None:
    walks, _, last = walked(fixed=True)
    assert (walks == 1).all()
    np.testing.assert_array_equal(last, np.arange(ROWS))
