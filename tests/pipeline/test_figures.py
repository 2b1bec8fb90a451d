"""A figure made from scratch by the command line: capture, fit, renders beside photographs, and a caption with their
errors; then again from the kept files.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from services.bench.figures.__main__ import main
from services.core.verdict import MAX_ERROR


@pytest.mark.slow
def test_a_figure_is_made_from_nothing_and_its_fit_used_again(tmp_path: Path) -> None:
    arguments = ["--quick", "--only", "fig13", "--out", str(tmp_path)]
    assert main(arguments) == 0
    caption = (tmp_path / "fig13.txt").read_text()
    fitted, unseen = (float(number) for number in re.findall(r"([\d.]+) % on", caption))
    # A converged fit explains its images at least this well.
    assert 0 < fitted < 100 * MAX_ERROR
    assert 0 < unseen < 100 * MAX_ERROR
    with Image.open(tmp_path / "fig13.png") as image:
        assert np.asarray(image).std() > 30
    reports = {path: path.stat().st_mtime_ns for path in tmp_path.glob("work/*/job/fit/*.json")}
    assert reports
    assert main(arguments) == 0
    assert {path: path.stat().st_mtime_ns for path in reports} == reports
    assert (tmp_path / "fig13.txt").read_text() == caption
