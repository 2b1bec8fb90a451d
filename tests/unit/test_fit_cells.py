"""Cells in which losses are compared: squares of the coarse grid, the same at every resolution, never across two teeth,
never too few.
"""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.templates.incisor import build_incisor
from services.fit.measurements.blocks import PixelParts
from services.fit.measurements.view_stack import CELL_EDGE, MIN_CELLS, ViewStack, comparison_cells, on_coarse_grid
from services.phantom.dome_rig import dome_cameras


def view(width: int, height: int, step: int = 1, shown: np.ndarray | None = None) -> ViewStack:
    (camera,) = dome_cameras(1, 1.0, (build_incisor().outer,))
    x, y = np.meshgrid(step * np.arange(width), step * np.arange(height))
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.int32)
    values = np.ones((2, len(pixels)))
    parts = None if shown is None else PixelParts(shown.astype(np.int16), shown.astype(np.int16))
    return ViewStack(camera, pixels, values, values, values > 0, np.zeros(2, dtype=bool), parts)


@pytest.mark.parametrize("step", [1, 2])
def test_cells_are_squares_of_coarse_pixels(step: int) -> None:
    seen = view(24, 24, step)
    cell = comparison_cells(seen, 600)
    assert set(np.bincount(cell)) == {CELL_EDGE**2}
    for k in np.unique(cell):
        assert np.ptp(seen.pixels[cell == k], axis=0).max() == step * (CELL_EDGE - 1)


def test_a_finer_image_has_the_same_cells_with_more_pixels_in_each() -> None:
    fine = view(96, 96)
    kept = on_coarse_grid(fine.pixels, np.ones(len(fine.pixels), dtype=bool), 600)
    cell = comparison_cells(fine, 600)
    assert kept.sum() == 576
    assert set(np.bincount(cell[kept])) == {CELL_EDGE**2}
    assert set(np.bincount(cell)) == {(4 * CELL_EDGE) ** 2}


def test_few_pixels_have_smaller_cells() -> None:
    # 96 pixels make 24 squares of four; of twelve pixels, and of one, every pixel is its own cell.
    assert len(np.unique(comparison_cells(view(12, 8), 600))) == MIN_CELLS
    assert len(np.unique(comparison_cells(view(4, 3), 600))) == 12
    np.testing.assert_array_equal(comparison_cells(view(1, 1), 600), [0])


def test_no_cell_holds_two_teeth() -> None:
    shown = np.tile(np.arange(24) >= 10, 24).astype(int)
    cell = comparison_cells(view(24, 24, shown=shown), 600)
    for k in np.unique(cell):
        assert len(np.unique(shown[cell == k])) == 1


def test_nothing_fitted_is_no_fault() -> None:
    seen = view(5, 5)
    blind = ViewStack(seen.camera, seen.pixels, seen.reference, seen.variance, np.zeros_like(seen.valid), seen.held_out)
    np.testing.assert_array_equal(comparison_cells(blind, 600), 0)
