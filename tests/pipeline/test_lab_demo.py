"""A coarse virtual laboratory, from its raw frames to the comparison of the fit with the truth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from services.cli.app import build_app
from services.phantom.lab.make import COARSE_SIZE, LAB_RECORD, TRUTH, make_lab


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_tooth_is_measured_from_raw_frames(tmp_path: Path) -> None:
    arguments = ["lab-demo", "--coarse", "--out", str(tmp_path), "--workers", "1", "--json"]
    outcome = CliRunner().invoke(build_app(), arguments, catch_exceptions=False)
    assert outcome.exit_code == 0
    told = json.loads(outcome.stdout)
    # The limits are the design's target for the position, and three times the error of rotation with pixels of 0.19 mm
    # (docs/measured/registration.md).
    assert told["steps"]["teeth_mm"] < 0.05
    assert told["steps"]["teeth_deg"] < 0.25
    asked = told["asked"]["held-out error over that with perfect calibration and pose"]
    assert asked["value"] < asked["limit"]
    assert (tmp_path / "summary.html").is_file()
    # A complete existing result is kept.
    before = (tmp_path / TRUTH / LAB_RECORD).stat().st_mtime_ns
    assert not make_lab(tmp_path, COARSE_SIZE, 3, 1, lambda _: None)
    assert (tmp_path / TRUTH / LAB_RECORD).stat().st_mtime_ns == before
