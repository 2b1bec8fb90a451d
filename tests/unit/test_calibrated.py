"""What a calibration holds about cameras and lights besides their positions."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight, Lobe
from services.core.calibration.record import Calibration, lit_at, require_consistent
from services.core.calibration.state import broken_limits, require_within_limits, state_of, warning_of_age
from services.core.errors import CaptureInputError
from services.core.geometry import Light
from services.core.records import FolderCapture

CAMERA: dict[str, Any] = {
    "name": "c0",
    "size": [40, 30],
    "K": [[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]],
    "camera_from_world": np.eye(4).tolist(),
}
LIGHT: dict[str, Any] = {"name": "l0", "position_mm": [0, 0, -500], "intensity": [1.0, 1.0]}


def calibration(camera: dict[str, Any], **more: Any) -> Calibration:
    own = {"units": "mm", "channels": ["green", "blue"], "cameras": [CAMERA | camera], "lights": [LIGHT]}
    tree = own | more
    return Calibration.model_validate_json(json.dumps(tree))


def test_an_earlier_calibration_is_stored_as_before() -> None:
    # The name of a stored calibration is the digest of its text, which new fields must not change.
    stored = json.loads(calibration({}).model_dump_json())
    assert stored.keys() == {"units", "channels", "cameras", "lights", "uncertainty"}
    assert stored["cameras"][0].keys() == CAMERA.keys()
    assert stored["lights"][0].keys() == LIGHT.keys()


def test_all_that_is_measured_is_kept() -> None:
    camera = {
        "distortion": [0.1, -0.2, 0.001, 0.002, 0.0],
        "vignetting": [-0.3, 0.1, 0.0],
        "radiance_per_count": [2e-3, 3e-3, 3e-3],
        "black_counts": 64.0,
        "read_noise_counts": 1.5,
        "counts_per_electron": 0.25,
        "crosstalk": [[1.0, 0.05, 0.0], [0.02, 1.0, 0.0], [0.0, 0.0, 1.0]],
    }
    colour = {"c0": {"xyz_from_rgb": np.eye(3).tolist(), "root_polynomial": None}}
    more = {"made": "2026-11-25T10:00:00Z", "valid_days": 30, "inputs": {"raw.toml": "ab"}, "colour": colour}
    more |= {"channels": ["red", "green", "blue"], "lights": [LIGHT | {"intensity": [1.0, 1.0, 1.0]}]}
    made = calibration(camera, **more)
    require_consistent(made, "It")
    assert Calibration.model_validate_json(made.model_dump_json()) == made
    assert made.cameras[0].vignetting_factor(0.5) == pytest.approx(1 - 0.3 * 0.5 + 0.1 * 0.25)


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


def shining(exponent: float, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> CalibratedLight:
    lobe = Lobe(axis=axis, exponent=exponent)
    return CalibratedLight(name="l0", position_mm=(0, 0, -1000), intensity=(2.0, 3.0), lobe=lobe)


def test_a_lobe_becomes_the_intensity_at_the_teeth() -> None:
    # 60 degrees beside the axis the cosine is a half, whatever the distance.
    seen = shining(3.0).towards((1000 * 3**0.5, 0.0, 0.0))
    assert type(seen) is Light
    assert seen.intensity == pytest.approx((2.0 / 8, 3.0 / 8))
    assert shining(3.0).towards((0.0, 0.0, 0.0)).intensity == pytest.approx((2.0, 3.0))


def test_a_light_that_shines_away_from_the_teeth_is_refused() -> None:
    description = FolderCapture(
        units="mm", channels=("green", "blue"), cameras=(), lights=(shining(2.0, (0.0, 0.0, -1.0)),)
    )
    with pytest.raises(CaptureInputError, match="Light l0 shines away from the teeth"):
        lit_at(description, (0.0, 0.0, 0.0))


DAY_S = 86_400.0
LIMITS = [{"what": "position of the lights, rms ±", "value": 2.5, "limit": 2.0, "unit": "mm"}]


@pytest.mark.parametrize(
    ("more", "days", "state"),
    [
        ({}, 0, "not known"),
        ({"made": "2026-11-25T10:00:00+00:00", "valid_days": 30}, 29, "good"),
        ({"made": "2026-11-25T10:00:00", "valid_days": 30}, 31, "old"),
        ({"limits": LIMITS}, 0, "beyond its limits"),
        ({"limits": [LIMITS[0] | {"value": None}]}, 0, "beyond its limits"),
        ({"limits": [LIMITS[0] | {"value": 1.9}]}, 0, "good"),
    ],
)
def test_a_calibration_tells_its_state(more: dict[str, Any], days: float, state: str) -> None:
    made = calibration({}, **more)
    now_s = datetime(2026, 11, 25, 10, tzinfo=UTC).timestamp() + days * DAY_S
    assert state_of(made.made, made.valid_days, broken_limits(made), now_s) == state
    assert (warning_of_age(made, "rig", now_s) is not None) == (state == "old")


def test_a_calibration_beyond_its_limits_is_refused_unless_accepted() -> None:
    made = calibration({}, limits=LIMITS)
    with pytest.raises(CaptureInputError, match=r"rms ± is 2.5 mm, and 2 mm is the limit; .*accept_calibration = true"):
        require_within_limits(made, "rig", accepted=False)
    require_within_limits(made, "rig", accepted=True)
