"""A board that one detector misses in one copy of a photograph is looked for again before anybody is blamed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from services.calibrate.cameras.boards import detect
from services.calibrate.session.boards import boards_in
from services.calibrate.session.photos import Photos, to_eight_bit
from services.core.raw.folder import parse_raw_folder

SQUARES = (10, 7)
DESCRIPTION = """
units = "mm"
[[camera]]
name = "left"
size = [320, 240]
bits = 8
channels = ["grey"]
[[board]]
name = "b"
type = "chessboard"
squares = [10, 7]
square_mm = 10
[[frame]]
camera = "left"
file = "one.png"
kind = "board"
board = "b"
exposure_s = 1
"""


def drawn(seed: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A small, blurred, noisy and unevenly lit chessboard, and its inner corners (54, 2), pixel centres at
    half-integers.
    """
    rng = np.random.default_rng(seed)
    plate = np.full((180, 240), 1.0)
    plate[20:160, 20:220] = np.kron(np.indices((7, 10)).sum(0) % 2, np.ones((20, 20)))
    around = np.array([[0, 0], [240, 0], [240, 180], [0, 180]], dtype=np.float32)
    width = rng.uniform(60, 120)
    placed = (around - [120, 90]) / 120 * width
    angle = rng.uniform(-0.5, 0.5)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    placed = placed @ turn.T * [1, rng.uniform(0.5, 1)] + [160, 120] + rng.uniform(-8, 8, (4, 2))
    shown = cv2.getPerspectiveTransform(around, placed.astype(np.float32))
    grey = cv2.warpPerspective(plate, shown, (320, 240), borderValue=rng.uniform(0.1, 0.8), flags=cv2.INTER_AREA)
    y, x = np.mgrid[:240, :320]
    shade = 1 + rng.uniform(-0.8, 0.8) * (x / 320 - 0.5) + rng.uniform(-0.8, 0.8) * (y / 240 - 0.5)
    grey = 20 + grey * rng.uniform(60, 190) * shade
    grey = cv2.GaussianBlur(grey, (0, 0), rng.uniform(0.6, 1.6)) + rng.normal(0, rng.uniform(1, 6), grey.shape)
    columns, rows = np.meshgrid(np.arange(40, 220, 20), np.arange(40, 160, 20))
    corners = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2) - 0.5
    pixels = cv2.perspectiveTransform(corners.astype(np.float64), shown).reshape(-1, 2) + 0.5
    return np.clip(grey, 0, 255).astype(np.uint8), pixels


@pytest.mark.parametrize("seed", [55, 60, 105, 156])
def test_a_board_that_the_first_look_misses_is_found(seed: int, tmp_path: Path) -> None:
    picture, corners = drawn(seed)
    cv2.imwrite(str(tmp_path / "one.png"), picture)
    folder = parse_raw_folder(DESCRIPTION.encode(), "raw.toml")
    assert len(detect(to_eight_bit(picture.astype(np.float32)), folder.board[0]).ids) == 0
    (view,), missed = boards_in(Photos(tmp_path, folder))
    assert missed == ()
    # The board is drawn from its black corner, and the order begins at the white one: another order is off by several
    # squares of 5 to 10 px. Single corners are off by up to 2.5 px, as the picture is blurred and noisy.
    off = np.linalg.norm(view.pixels - corners[::-1], axis=1)
    assert np.median(off) < 0.5
    assert off.max() < 4.0


def test_what_shows_no_board_stays_missed(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (240, 320))
    cv2.imwrite(str(tmp_path / "one.png"), noise.astype(np.uint8))
    folder = parse_raw_folder(DESCRIPTION.encode(), "raw.toml")
    views, missed = boards_in(Photos(tmp_path, folder))
    assert views == []
    assert missed[0][0] == "one.png"
