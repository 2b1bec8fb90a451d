"""What a preparation reports about its images, in numbers and on a page."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.core.store import read_record
from services.preprocess.quality.images import STOPS, QualityReport, by_stop
from services.preprocess.stage import run
from tests.support.folder_captures import write_folder


def test_pixels_are_counted_by_stop_with_their_noise() -> None:
    """Each stop is half as bright as the one before; its middle is 1.5 times its end."""
    radiance = np.repeat(1.5 * 0.5 ** np.arange(STOPS + 2), 50).reshape(-1, 50, 1).repeat(3, axis=2).astype(np.float32)
    variance = (0.1 * radiance) ** 2
    chosen = np.ones(radiance.shape[:2], dtype=bool)
    chosen[0] = False
    radiance[1, 0] = 2 * 0.75
    counts, noise = by_stop(radiance, variance, chosen)
    # The first row is not counted, and one pixel of the second is as bright as that; the last three share a stop
    assert counts == (1, 49, *[50] * (STOPS - 3), 150)
    # Three channels of independent noise
    assert noise[2] == pytest.approx(0.1 / np.sqrt(3))


def test_pixels_without_light_are_in_no_stop() -> None:
    dark = np.zeros((4, 5, 1), dtype=np.float32)
    assert by_stop(dark, dark, np.ones((4, 5), dtype=bool)) == ((0,) * STOPS, (None,) * STOPS)


def test_a_page_shows_every_image(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    write_folder(tmp_path / "capture")
    run(JobSpec(capture=tmp_path / "capture"), LocalContext(tmp_path / "job"))
    folder = tmp_path / "job" / "prepared"
    report = read_record(folder / "quality.json", QualityReport)
    page = (folder / "quality" / "index.html").read_text()
    shown = re.findall(r'src="([^"]+)"', page)
    assert sorted(shown) == sorted(f"{image.camera}_{image.light}.png" for image in report.images)
    assert all((folder / "quality" / name).is_file() for name in shown)
    for image in report.images:
        assert f"{image.valid_pixels} of {image.tooth_pixels} pixels are valid" in page
        assert sum(image.levels) == image.tooth_pixels
    # Nothing is loaded from elsewhere
    assert "http" not in page
