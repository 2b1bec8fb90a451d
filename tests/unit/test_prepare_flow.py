"""The optical flow of a known motion, and how it is drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from services.preprocess.quality.flow import camera_flow, write_flow
from services.preprocess.views.flow_comparison import FlowComparison, compare_flow

SHIFT_PX = (2.5, -1.0)
HEIGHT, WIDTH, MARGIN = 120, 160, 12


def spots(shift_px: tuple[float, float]) -> NDArray[np.float32]:
    """Smooth spots of 3 px (standard deviation 0.2) about 1, moved this far to the right and down."""
    noise = np.random.default_rng(2).standard_normal((HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 3)
    matrix = np.array([[1, 0, shift_px[0]], [0, 1, shift_px[1]]], dtype=np.float64)
    moved = cv2.warpAffine(1 + 0.2 * blurred / blurred.std(), matrix, noise.shape[::-1], flags=cv2.INTER_CUBIC)
    return np.asarray(moved, dtype=np.float32)


@pytest.fixture(scope="module")
def flow() -> FlowComparison:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32) + MARGIN
    places = np.stack([x + np.float32(SHIFT_PX[0]), y + np.float32(SHIFT_PX[1])])
    inner = slice(MARGIN, MARGIN + HEIGHT), slice(MARGIN, MARGIN + WIDTH)
    teeth = np.zeros((HEIGHT, WIDTH), dtype=bool)
    teeth[10:-10, 20:-20] = True
    return compare_flow(7, spots((0, 0)), spots(SHIFT_PX), inner, places, teeth)


def test_flow_sees_the_motion_and_none_once_it_is_taken_out(flow: FlowComparison) -> None:
    """Dense flow is known to err by 0.2 px in the median on rendered teeth; a shift of clear spots is easier."""
    assert np.median(flow.before[flow.teeth], axis=0) == pytest.approx(SHIFT_PX, abs=0.1)
    numbers = camera_flow("left", flow)
    assert numbers is not None
    assert numbers.before_px[0] == pytest.approx(np.hypot(*SHIFT_PX), abs=0.1)
    assert numbers.after_px[0] < 0.1
    assert numbers.scale_px == numbers.before_px[1]


def test_pictures_show_direction_and_how_much_is_left(flow: FlowComparison, tmp_path: Path) -> None:
    numbers = camera_flow("left", flow)
    assert numbers is not None
    write_flow(tmp_path, flow, numbers)
    before, after = (cv2.imread(str(tmp_path / f"left_{name}.png")) for name in ("before", "after"))
    assert before is not None
    assert after is not None
    assert before.shape == (HEIGHT, WIDTH, 3)
    assert not before[~flow.teeth].any()
    # To the right and a little up: red, with more blue than green in it; afterwards white, to the last tenth in the
    # median
    blue, green, red = np.median(before[flow.teeth], axis=0)
    assert red == 255
    assert blue > green
    assert np.median(after[flow.teeth].min(axis=-1)) > 0.9 * 255


def test_flow_without_teeth_has_no_numbers(flow: FlowComparison) -> None:
    assert camera_flow("left", FlowComparison(7, flow.before, flow.after, np.zeros_like(flow.teeth))) is None
