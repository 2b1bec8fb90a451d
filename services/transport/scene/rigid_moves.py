"""Rigid moves of a scan, given as moves of what looks at it and lights it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import TWIST
from services.core.geometry import Camera, Light

Array = NDArray[np.float64]

SCAN = tuple(f"teeth.{axis}" for axis in TWIST)
"""Names of the six coordinates."""


def rigid(twist: Array, centre_mm: Array) -> Array:
    """Rigid transform (4, 4) by a rotation vector (rad) and a translation (mm) about a centre; Rodrigues' formula."""
    angle = float(np.linalg.norm(twist[:3]))
    x, y, z = twist[:3] / angle if angle > 0 else np.zeros(3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    move = np.eye(4)
    move[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    move[:3, 3] = centre_mm + twist[3:] - move[:3, :3] @ centre_mm
    return move


def twist_of(errors: Mapping[str, float]) -> Array:
    """Rotation vector and translation (6,) of the scan among an instrument's errors; 0 where they are not named."""
    return np.array([errors.get(name, 0.0) for name in SCAN])


def moved_camera(camera: Camera, move: Array) -> Camera:
    """Camera that sees a fixed scan as ``camera`` sees the scan moved by a rigid transform (4, 4)."""
    pose = np.asarray(camera.camera_from_world) @ move
    return Camera.model_validate(camera.model_dump() | {"camera_from_world": tuple(map(tuple, pose.tolist()))})


def moved_light(light: Light, move: Array) -> Light:
    """Light that shines on a fixed scan as ``light`` shines on the scan moved by a rigid transform (4, 4)."""
    place_mm = np.linalg.inv(move) @ np.array([*light.position_mm, 1.0])
    return light.model_copy(update={"position_mm": tuple(place_mm[:3].tolist())})
