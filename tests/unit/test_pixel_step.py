"""Choice of the squares of pixels that a fit compares."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from services.core.geometry import Camera
from services.core.records import JobSpec
from services.core.store import create_array
from services.core.values import MAX_SQUARE_MM
from services.fit.measurements.pixel_step import MIN_KEPT, chosen_pixel_step, kept_share

PIXEL_MM, DISTANCE_MM, EDGE = 0.064, 300.0, 84
CENTRE_MM = np.zeros(3)


def choose(folder: Path, valid: NDArray[np.bool_], **options: Any) -> int:
    focal = DISTANCE_MM / PIXEL_MM
    camera = Camera(
        name="c0",
        size=(EDGE, EDGE),
        K=((focal, 0.0, EDGE / 2), (0.0, focal, EDGE / 2), (0.0, 0.0, 1.0)),
        camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, DISTANCE_MM), (0, 0, 0, 1)),
    )
    bits = np.where(valid, 0, 1).astype(np.uint16)[None, None]
    create_array(folder / "prepared.zarr", "valid", bits.shape, bits.shape, "uint16", ("camera", "light", "y", "x"))[
        :
    ] = bits
    manifest: Any = SimpleNamespace(cameras=(camera,), lights=("l0",))
    return chosen_pixel_step(folder, manifest, CENTRE_MM, JobSpec(capture=folder, **options))


def test_the_largest_square_that_is_not_longer_than_half_a_millimetre(tmp_path: Path) -> None:
    step = choose(tmp_path, np.ones((EDGE, EDGE), dtype=bool))
    assert step == int(MAX_SQUARE_MM / PIXEL_MM) == 7


def test_smaller_squares_where_masks_break_the_large_ones(tmp_path: Path) -> None:
    """Every fifth pixel in x and y is masked, so no square of 5 or more is whole; of those of 4 pixels a third is,
    of those of 3 two thirds.
    """
    valid = np.ones((EDGE, EDGE), dtype=bool)
    valid[::5, ::5] = False
    assert choose(tmp_path, valid) == 3
    assert kept_share([valid], 5) == 0
    assert kept_share([valid], 3) > MIN_KEPT


def test_stains_and_a_given_number_are_not_overruled(tmp_path: Path) -> None:
    everything = np.ones((EDGE, EDGE), dtype=bool)
    assert choose(tmp_path / "a", everything, stains=True) == 1
    assert choose(tmp_path / "b", everything, pixel_step=4) == 4


@pytest.mark.parametrize("wrong", [0, 65, 2.5, "fine", True, None, float("inf"), float("nan")])
def test_another_value_is_refused_in_words(tmp_path: Path, wrong: object) -> None:
    with pytest.raises(ValidationError, match='give "auto" or a whole number from 1 to 64'):
        JobSpec.model_validate({"capture": tmp_path, "pixel_step": wrong})
