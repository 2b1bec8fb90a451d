"""Comparing two calibrations: what chance explains is not reported as a change."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.calibrate.cameras.rotations import rotation_matrix
from services.calibrate.session.drift import changes
from services.core.calibration.record import Calibration
from services.core.errors import CaptureInputError

LIGHTS = 1000 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0.5, 0.5, 0.7]])
POSITION_SE_MM, GAIN_SE, FOCAL_SE = 1.5, 0.003, 2e-4


def drawn(seed: int, moved_mm: NDArray[np.float64] | float = 0.0, dimmed: float = 0.0) -> Calibration:
    """A calibration with normally distributed errors, in its own world frame."""
    random = np.random.default_rng(seed)
    turn, shift = rotation_matrix(random.normal(size=3)), random.normal(0, 100, 3)
    places = (LIGHTS + moved_mm + random.normal(0, POSITION_SE_MM, LIGHTS.shape)) @ turn.T + shift
    gains = np.exp(random.normal(0, GAIN_SE, 5) + dimmed * (np.arange(5) == 3))
    names = [f"light.L{n}.{axis}" for n in range(5) for axis in "xyz"]
    names += [f"light_gain.L{n}.grey" for n in range(5)] + [f"camera.c.{key}" for key in ("fx", "fy", "cx", "cy")]
    se = [POSITION_SE_MM] * 15 + [GAIN_SE] * 5 + [FOCAL_SE] * 2 + [0.5] * 2
    focal, middle = 2000 * (1 + random.normal(0, FOCAL_SE, 2)), 500 + random.normal(0, 0.5, 2)
    K = [[focal[0], 0, middle[0]], [0, focal[1], middle[1]], [0, 0, 1]]
    camera = {"name": "c", "size": [1000, 1000], "K": K, "camera_from_world": np.eye(4).tolist()}
    lights = [{"name": f"L{n}", "position_mm": places[n].tolist(), "intensity": [float(gains[n])]} for n in range(5)]
    uncertainty = {"names": names, "covariance": np.diag(np.square(se)).tolist()}
    told = {"units": "mm", "channels": ["grey"], "cameras": [camera], "lights": lights, "uncertainty": uncertainty}
    return Calibration.model_validate(told)


def test_changes_of_a_still_rig_are_as_large_as_their_errors() -> None:
    """Fifty comparisons of 14 quantities: their rms has a standard error of 0.03, or more, as the lights share a
    middle.
    """
    scores = [one.change / one.se for seed in range(50) for one in changes(drawn(2 * seed), drawn(2 * seed + 1))]
    assert len(scores) == 50 * 14
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1


def test_what_changed_is_named_first() -> None:
    moved = np.zeros((5, 3))
    moved[1] = [0, 15, 0]
    told = changes(drawn(1), drawn(2, moved, dimmed=-0.05))
    assert {one.what for one in told[:2]} == {
        "intensity of light L3 in grey",
        "distance of light L1 from the lights' middle",
    }
    assert all(one.is_clear for one in told[:2])
    dimmer = next(one for one in told if "intensity" in one.what)
    assert dimmer.change == pytest.approx(-5, abs=4 * dimmer.se)
    assert dimmer.sentence.startswith("intensity of light L3 in grey changed by -")


def test_without_errors_nothing_is_compared() -> None:
    silent = drawn(1).model_copy(update={"uncertainty": None})
    assert changes(silent, drawn(2)) == []


def test_calibrations_of_other_channels_are_not_compared() -> None:
    other = drawn(2).model_copy(update={"channels": ("green",)})
    with pytest.raises(CaptureInputError, match="has channels green and this one grey"):
        changes(other, drawn(1))
