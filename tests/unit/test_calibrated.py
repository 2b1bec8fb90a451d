"""What a calibration says of cameras and lights beside where they are."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.calibration.record import Calibration, require_consistent
from services.core.errors import CaptureInputError

CAMERA: dict[str, Any] = {
    "name": "c0",
    "size": [40, 30],
    "K": [[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]],
    "camera_from_world": np.eye(4).tolist(),
}
LIGHT: dict[str, Any] = {"name": "l0", "position_mm": [0, 0, -500], "intensity": [1.0, 1.0]}


def calibration(camera: dict[str, Any], **more: Any) -> Calibration:
    tree = {"units": "mm", "channels": ["green", "blue"], "cameras": [CAMERA | camera], "lights": [LIGHT], **more}
    return Calibration.model_validate_json(json.dumps(tree))


def test_an_earlier_calibration_is_stored_as_before() -> None:
    # A stored calibration's name is the digest of its text, which further fields must not change.
    stored = json.loads(calibration({}).model_dump_json())
    assert stored.keys() == {"units", "channels", "cameras", "lights", "uncertainty"}
    assert stored["cameras"][0].keys() == CAMERA.keys()
    assert stored["lights"][0].keys() == LIGHT.keys()


def test_all_that_is_measured_is_kept() -> None:
    camera = {
        "distortion": [0.1, -0.2, 0.001, 0.002, 0.0],
        "vignetting": [-0.3, 0.1, 0.0],
        "radiance_per_count": [2e-3, 3e-3],
        "black_counts": 64.0,
        "read_noise_counts": 1.5,
        "counts_per_electron": 0.25,
        "crosstalk": [[1.0, 0.05], [0.02, 1.0]],
    }
    colour = {"c0": {"xyz_from_rgb": np.eye(3).tolist(), "root_polynomial": None}}
    more = {"made": "2026-11-25T10:00:00Z", "valid_days": 30, "inputs": {"raw.toml": "ab"}, "colour": colour}
    made = calibration(camera, **more)
    require_consistent(made, "It")
    assert Calibration.model_validate_json(made.model_dump_json()) == made
    assert made.cameras[0].fall_of_light(0.5) == pytest.approx(1 - 0.3 * 0.5 + 0.1 * 0.25)


@pytest.mark.parametrize(
    ("camera", "pattern"),
    [
        ({"distortion": [0.1]}, r"distortion has 1 numbers, and OpenCV's models have 4, 5, 8, 12, 14"),
        ({"vignetting": [-2.0, 0.0, 0.0]}, r"vignetting leaves no light"),
        ({"crosstalk": [[1.0, 0.1]]}, r"crosstalk has not as many columns as rows"),
        ({"gamma": 2.2}, r"gamma"),
    ],
)
def test_what_no_camera_has(camera: dict[str, Any], pattern: str) -> None:
    with pytest.raises(ValidationError, match=pattern):
        CalibratedCamera.model_validate_json(json.dumps(CAMERA | camera))


@pytest.mark.parametrize("camera", [{"radiance_per_count": [1.0]}, {"crosstalk": [[1.0]]}])
def test_numbers_of_other_channels_are_refused(camera: dict[str, Any]) -> None:
    with pytest.raises(CaptureInputError, match=rf"camera c0 has {next(iter(camera))} of 1 channels, and there are 2"):
        require_consistent(calibration(camera), "It")
