"""Descriptions that name one thing twice, and dates on which nothing was made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.calibration.record import Calibration, require_consistent, require_date, require_own_files
from services.core.errors import CaptureInputError
from services.core.raw.folder import read_raw_folder
from services.core.raw.frames import read_frame
from services.core.records import FolderCapture, ImageEntry
from tests.support.dng_files import write_dng
from tests.support.raw_folders import write_toml

NOW_S = 1_790_000_000.0


def capture(files: tuple[tuple[str, str | None], ...], channels: tuple[str, ...] = ("red", "blue")) -> FolderCapture:
    images = tuple(
        ImageEntry(camera="c0", light=f"L{k}", file=file, variance_file=variance)
        for k, (file, variance) in enumerate(files)
    )
    return FolderCapture(units="mm", channels=channels, cameras=(), lights=(), images=images)


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ((("a.npy", None), ("a.npy", None)), "file a.npy for camera c0 under light L0 and again for .* light L1"),
        ((("a.npy", None), ("./a.npy", None)), "file ./a.npy"),
        ((("a.npy", "a.npy"),), "file a.npy"),
        ((("a.npy", "v.npy"), ("b.npy", "a.npy")), "file a.npy"),
    ],
)
def test_one_file_for_several_images_is_refused(files: tuple[tuple[str, str | None], ...], words: str) -> None:
    with pytest.raises(CaptureInputError, match=f"names {words}.*; give each .*file of its own"):
        require_own_files(capture(files), "capture.json")


def test_images_may_share_their_variance() -> None:
    require_own_files(capture((("a.npy", "v.npy"), ("b.npy", "v.npy"))), "capture.json")


def test_a_channel_listed_twice_is_refused() -> None:
    with pytest.raises(CaptureInputError, match="lists channel red twice"):
        require_own_files(capture((), ("red", "red")), "capture.json")


@pytest.mark.parametrize(
    "made", ["0000-00-00", "9999-12-31", "9999-12-31T23:59:59-12:00", "1905-01-01", "today", "", "2026-13-01"]
)
def test_a_date_on_which_nothing_was_made_is_refused(made: str) -> None:
    with pytest.raises(CaptureInputError, match=r"no date|still to come"):
        require_date(made, "Calibration c.json", NOW_S)
    calibration = Calibration(units="mm", channels=("grey",), cameras=(), lights=(), made=made)
    with pytest.raises(CaptureInputError):
        require_consistent(calibration, "Calibration c.json")


@pytest.mark.parametrize(
    "made", ["2026-01-31", "2026-01-31T12:00:00", "2026-01-31T12:00:00Z", "2020-01-01T00:00:00+05:00"]
)
def test_a_date_of_the_past_is_accepted(made: str) -> None:
    require_date(made, "Calibration c.json", NOW_S)


def test_a_camera_raw_file_whose_greens_contradict_its_pattern_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(1000, 10, (48, 64))
    values[::2, ::2] *= 1.4  # the greens lie on this diagonal, and the file states the other one
    values[1::2, 1::2] *= 1.4
    values[::2, 1::2] *= 0.5
    write_dng(tmp_path / "x.dng", values.astype(np.uint16), (0, 1, 1, 2))
    frame = {"camera": "c", "file": "x.dng", "kind": "flat", "exposure_s": 1.0}
    camera = {"name": "c", "size": [64, 48], "bits": 12, "mosaic": "RGGB"}
    write_toml(tmp_path, {"units": "mm", "camera": [camera], "frame": [frame]})
    folder = read_raw_folder(tmp_path)
    with pytest.raises(CaptureInputError, match=r"green pixels that differ by .* the file states a wrong pattern"):
        read_frame(tmp_path, folder, folder.frame[0])
