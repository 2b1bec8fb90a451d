"""What is measured from the frames of a camera is measured once for each preparation, and then used by all of its
blocks.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.raw.description import read_calibration
from services.core.raw.folder import read_raw_folder
from services.core.raw.frames import read_counts
from services.core.raw.records import RawFolder, RawFrame
from services.preprocess.raw import camera as module
from services.preprocess.raw.camera import CameraFrames
from tests.support.mouth import write_mouth
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor


def test_another_block_takes_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "raw"
    write_mouth(tmp_path / "mouth", lights=2, sizes=((96, 72),))
    write_raw_capture(root, tmp_path / "mouth", Sensor(), tracking=0, flats=2)
    folder = read_raw_folder(root)
    calibrated = read_calibration(root, folder, None).cameras[0]
    asked: list[str] = []

    def counted(root: Path, folder: RawFolder, frame: RawFrame) -> np.ndarray:
        asked.append(frame.file)
        return read_counts(root, folder, frame)

    monkeypatch.setattr(module, "read_counts", counted)
    first, second, anew = (
        CameraFrames(root, folder, calibrated, (0.01, 1e-3), kept) for kept in (tmp_path, tmp_path, None)
    )
    measuring = len(asked) // 2
    assert asked == asked[:measuring] * 2, "the second one reads nothing, and without a folder all is read again"
    assert measuring > 0
    assert second.noise == first.noise == anew.noise
    assert second.noise.counts_per_electron > 0
    assert second.linearity.curve == first.linearity.curve
    assert second.lens == first.lens == anew.lens
    assert any(second.lens.vignetting)
    assert second.notes == first.notes == anew.notes
    lit = folder.frames_of(calibrated.name, "light")[0]
    taken, measured = second.exposure(lit), first.exposure(lit)
    np.testing.assert_array_equal(taken.signal, measured.signal)
    assert taken.extra_variance == measured.extra_variance
