"""Whole calibration sessions with random errors keep the limits, and their stated standard errors are right."""

from __future__ import annotations

import pytest

from tests.benchmarks.calibrate_sessions import one_session, summary


@pytest.mark.slow
def test_sessions_keep_their_limits_and_know_their_errors() -> None:
    """Four sessions give 168 scores of cameras and 144 each of lights and intensities, so that their rms has a standard
    error of 0.06.
    """
    told = summary([one_session(seed) for seed in range(4)])
    assert told["rms_shift_mm"] < 0.05
    assert told["rms_turn_deg"] < 0.02
    assert told["rms_lights_mm"] < 2
    assert told["rms_intensity"] < 5e-3
    assert told["rms_delta_e"] < 1
    for key in ("z_cameras", "z_lights", "z_intensity"):
        assert 0.8 < told[f"rms_{key}"] < 1.25
