"""JPEGs: photographs of boards need no counts, all others do."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from services.calibrate.session.photos import Photos
from services.capture.raw.importing import import_folder
from services.core.errors import CaptureInputError
from services.core.raw.folder import parse_raw_folder
from services.core.raw.frames import read_counts
from services.core.raw.records import RawFolder
from tests.support.raw_folders import counts

DESCRIPTION = """
units = "mm"
[[camera]]
name = "left"
size = [60, 40]
bits = 12
mosaic = "RGGB"
[[board]]
name = "b"
type = "chessboard"
squares = [5, 4]
square_mm = 10
[[light]]
name = "L1"
[[frame]]
camera = "left"
file = "one.jpg"
kind = "board"
board = "b"
exposure_s = 1
[[frame]]
camera = "left"
file = "two.jpg"
kind = "light"
light = "L1"
exposure_s = 1
"""


@pytest.fixture
def folder(tmp_path: Path) -> RawFolder:
    rows, columns = np.mgrid[:40, :60]
    picture = np.where((rows // 10 + columns // 10) % 2, 230, 20).astype(np.uint8)
    for name in ("one", "two"):
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), cv2.merge([picture] * 3))
    return parse_raw_folder(DESCRIPTION.encode(), "raw.toml")


def test_a_jpeg_of_a_board_is_read(folder: RawFolder, tmp_path: Path) -> None:
    grey = Photos(tmp_path, folder).grey(folder.frame[0])
    assert grey.shape == (40, 60)
    # JPEG rings by some levels at edges.
    assert grey[:8, :8].max() < 40
    assert grey[:8, 12:18].min() > 200


def test_a_jpeg_that_is_none_is_refused(folder: RawFolder, tmp_path: Path) -> None:
    (tmp_path / "one.jpg").write_bytes(b"no picture")
    with pytest.raises(CaptureInputError, match="cannot be read as a JPEG; it may be truncated"):
        read_counts(tmp_path, folder, folder.frame[0])


def test_a_jpeg_of_teeth_is_refused(folder: RawFolder, tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match=r"is a JPEG, .* which only a frame of kind board may be; export"):
        read_counts(tmp_path, folder, folder.frame[1])


def test_a_jpeg_of_another_size_is_refused(folder: RawFolder, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "one.jpg"), np.zeros((60, 40), np.uint8))
    with pytest.raises(CaptureInputError, match=r"40 x 60 pixels \(turned by 90 degrees\?\)"):
        read_counts(tmp_path, folder, folder.frame[0])


def test_an_import_takes_jpegs_of_boards_alone(tmp_path: Path) -> None:
    np.save(tmp_path / "left_L1_10ms.npy", counts(1, 1))
    for name in ("left_board1", "left_L2"):
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), np.zeros(counts(1, 1).shape[:2], np.uint8))
    said = import_folder(tmp_path, None, "RGGB", None).missing
    written = (tmp_path / "raw.toml").read_text()
    assert 'file = "left_board1.jpg"' in written
    assert "left_L2.jpg" not in written
    assert any("1 of .jpg" in one and "JPEGs may only show boards" in one for one in said)


def test_jpegs_of_no_board_are_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "left_L2.jpg"), np.zeros((4, 4), np.uint8))
    with pytest.raises(CaptureInputError, match=r"holds no photograph of counts .*JPEGs may only show boards"):
        import_folder(tmp_path, None, None, None)
