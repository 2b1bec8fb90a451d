"""The stored jaw's file format and the capture written from it, with images made up here; ``render_jaw_truth`` makes
the real ones.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.core.files.meshes import read_teeth
from services.core.records import FolderCapture
from services.core.store import read_record
from tests.support.jaw_truth import (
    CAMERAS,
    HELD_OUT,
    LIGHTS,
    NOISE_FLOOR,
    NOISE_RELATIVE,
    JawTruth,
    _of_neighbours,
    pack,
    read_jaw_truth,
    write_jaw_capture,
)

PASSES, SIZE = 8, (12, 30)
SPREAD = 0.05


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of brightness 1, and of half that from row 6, with noise in every pass; two rows are dark."""
    random = np.random.default_rng(2)
    path = tmp_path_factory.mktemp("truth") / "deep" / "jaw.npz"
    shape = (PASSES, LIGHTS, *SIZE)
    level = np.where(np.arange(SIZE[0]) < 6, 1.0, 0.5)[:, None]
    level[-2:] = 0
    pack(path, [level * (1 + SPREAD * random.standard_normal(shape)) for _ in range(CAMERAS)], samples=128)
    return path


@pytest.fixture(scope="module")
def truth(stored: Path) -> JawTruth:
    return read_jaw_truth(stored)


def test_means_and_their_variances_come_back(truth: JawTruth) -> None:
    assert len(truth.mean) == len(truth.cameras) == CAMERAS
    assert len(truth.lights) == LIGHTS
    assert truth.mean[0].shape == truth.variance[0].shape == (LIGHTS, *SIZE)
    assert truth.mean[0][:, 0].mean() == pytest.approx(1, abs=0.01)
    # 3,780 variances with 7 degrees of freedom: the mean's relative error is sqrt(2 / 7 / 3780) = 0.9 %.
    assert np.mean([variance[:, :6].mean() for variance in truth.variance]) == pytest.approx(
        SPREAD**2 / PASSES, rel=0.04
    )
    assert len(truth.mouth.teeth) == len(truth.jaw.teeth) == 14


def test_another_jaw_is_not_taken_for_the_rendered_one(stored: Path, tmp_path: Path) -> None:
    with np.load(stored) as arrays:
        kept = dict(arrays)
    kept["moments"] = kept["moments"] * np.array([1, 1, 1 + 1e-4, 1])
    np.savez(tmp_path / "other.npz", allow_pickle=False, **kept)
    with pytest.raises(AssertionError, match=r"is not the one of other\.npz"):
        read_jaw_truth(tmp_path / "other.npz")


def test_the_capture_has_the_sensors_noise(truth: JawTruth, tmp_path: Path) -> None:
    write_jaw_capture(tmp_path, truth, seed=3, dentin=False)
    capture = read_record(tmp_path / "capture.json", FolderCapture)
    assert len(capture.images) == CAMERAS * LIGHTS
    assert len({entry.light for entry in capture.images if entry.held_out}) == HELD_OUT
    assert all(tooth.dentin is None for tooth in read_teeth(tmp_path))
    assert set(json.loads((tmp_path / "truth.json").read_text())["channels"]["green"]["teeth"]) == {
        str(tooth.fdi) for tooth in truth.jaw.teeth
    }
    scores = []
    for entry in capture.images:
        camera, light = int(entry.camera[1:]), int(entry.light[1:])
        mean = truth.mean[camera][light]
        sensor = np.sqrt((NOISE_RELATIVE * mean) ** 2 + (NOISE_FLOOR * mean.max()) ** 2)
        scores.append((np.load(tmp_path / entry.file)[..., 0] - mean) / sensor)
    z = np.stack(scores)
    # 7,560 values: |mean| beyond 4 / sqrt(7560), or a standard deviation off by 4 / sqrt(2 x 7560), fails one run in
    # 8,000.
    assert z.size == 7560
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.std() - 1) < 4 / np.sqrt(2 * z.size)


def test_a_pixels_own_noise_does_not_set_its_weight() -> None:
    variance = np.zeros((1, 7, 7))
    variance[0, 2:] = 4.0
    variance[0, 4, 4] = 100.0
    smoothed = _of_neighbours(variance)
    assert smoothed[0, 4, 4] == pytest.approx(4.0)
    assert smoothed[0, 4, 3] == pytest.approx((23 * 4 + 100) / 24)
    # The mean of two rows of lit neighbours, without the dark ones.
    assert smoothed[0, 2, 0] == pytest.approx(4.0)
    assert smoothed[0, 1, 0] == pytest.approx(4.0)
