"""Blocks of renders are merged into squares, of what shows the tooth alone."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.cycles_colours import BLOCK, SIZE, merged


def test_squares_are_means_of_the_blocks_that_show_the_tooth() -> None:
    columns, rows = (size // BLOCK for size in SIZE)
    values = np.arange(2 * columns * rows * 3, dtype=float).reshape(2, columns * rows, 3)
    shown = np.zeros((rows, columns), dtype=bool)
    shown[0, :2] = shown[3, 4] = True
    # Half of the first square shows the tooth, and a quarter of the other one.
    found = merged(values, shown.reshape(-1), 2)
    np.testing.assert_array_equal(found, values[:, :2].mean(axis=1, keepdims=True))
    np.testing.assert_array_equal(merged(values, shown.reshape(-1), 1), values[:, shown.reshape(-1)])
