"""How a slab's fit is judged on cells that it has not seen; noise does not count as its error."""

from __future__ import annotations

import numpy as np
import pytest

from services.bench.slab.novel import WIDTHS_MM, novel_folder
from services.bench.slab.recovery import squared_share


def test_noise_of_batches_is_not_taken_for_a_difference() -> None:
    noise = np.random.default_rng(1).normal(size=(16, 4000))
    squared, spread = squared_share(0.1 + noise, 4000.0)
    # The noise is ten times the difference; its square would make this a hundred times as large. Three standard errors.
    assert abs(squared - 0.01) < 3 * spread < 0.01


def test_without_noise_the_square_is_exact() -> None:
    squared, spread = squared_share(np.full((4, 10), 0.3), 10.0)
    assert squared == pytest.approx(0.09, rel=1e-12)
    assert spread == pytest.approx(0, abs=1e-12)


def test_novel_cells_have_other_beams_and_the_widths_asked_for() -> None:
    for width_mm in WIDTHS_MM:
        folder = novel_folder(width_mm)
        assert folder.cell.width_mm == width_mm
        assert [light.angle_deg for light in folder.lights] == [10, 20]
        assert len(folder.images) == 2 * len(folder.cameras)
