"""The true rig of a virtual laboratory: cameras with lenses, and lights, all deviating a little from their plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.core.calibration.record import Calibration
from services.core.geometry import Mesh
from services.phantom.dome_rig import dome_cameras, dome_lights

Floats = NDArray[np.float64]
CHANNELS = ("red", "green", "blue")
CAMERA_MM = 500.0
"""Distance from the teeth to each camera, mm; short enough that boards distinguish focal length from distance."""
LENS = (-0.35, 0.3, 0.001, -0.0006)
"""Radial and tangential distortion in OpenCV's order: one or two pixels in the corners of an image of half a
megapixel."""
CAMERA_SD_MM, CAMERA_SD_DEG, FOCAL_SD, CENTRE_SD_PX = 4.0, 0.5, 0.02, 6.0
"""Standard deviations of a mounted camera from the plan: position (each coordinate), direction (each axis), focal
length (relative) and principal point (each coordinate)."""
LIGHT_SD_MM, LIGHT_SPREAD = 8.0, 0.2
"""Standard deviation of each coordinate of a light's position, and relative half width of the uniform draw of its
brightness."""
WHITE_COUNTS_PER_S = 1.3e5
"""Counts per second of a white diffuser at a metre from a light of intensity 1, in a camera's green channel: 2600
counts in a fiftieth of a second."""
RESPONSE = (0.8, 1.0, 0.7)
"""Relative response of a sensor in red, green and blue."""
RESPONSE_SD = 0.05
"""Relative standard deviation of the response between cameras and channels."""


@dataclass(frozen=True)
class RigSize:
    """Size of a rig's images, and its numbers of cameras and lights.

    Attributes:
        pixels: width and height of an image.
        pixel_mm: size of a pixel at the teeth.
        cameras, lights: numbers of cameras and lights.
    """

    pixels: tuple[int, int]
    pixel_mm: float
    cameras: int
    lights: int


def true_rig(size: RigSize, sensor_black: float, seed: int) -> Calibration:
    """Draw a rig that deviates randomly from its plan, in the frame of the mouth, whose teeth are at the origin.

    Args:
        size: size of images, and numbers of cameras and lights.
        sensor_black: counts without light.
        seed: seed of the draw.
    """
    random = np.random.default_rng([seed, 0x716])
    planned = dome_cameras(size.cameras, 1.0, (Mesh(np.zeros((1, 3)), np.zeros((0, 3), dtype=np.int32)),))
    cameras = [_camera(one.name, np.array(one.camera_from_world), size, sensor_black, random) for one in planned]
    positions_mm = np.array([one.position_mm for one in dome_lights(size.lights, CHANNELS, seed)])
    positions_mm += random.normal(0, LIGHT_SD_MM, positions_mm.shape)
    intensity = 1 + LIGHT_SPREAD * random.uniform(-1, 1, (size.lights, 1)) + 0.03 * random.normal(size=(size.lights, 3))
    # Apply the gauge of all calibrations: the mean of the lights' intensities is 1 in every channel.
    intensity /= intensity.mean(axis=0)
    lights = [
        CalibratedLight(name=f"L{n}", position_mm=tuple(position), intensity=tuple(own))
        for n, (position, own) in enumerate(zip(positions_mm.tolist(), intensity.tolist(), strict=True))
    ]
    return Calibration(units="mm", channels=CHANNELS, cameras=tuple(cameras), lights=tuple(lights))


def in_session_frame(rig: Calibration, world_from_session: Floats) -> Calibration:
    """Transform a rig to the frame of a session's first board, which is the frame of a calibration."""
    session_from_world = np.linalg.inv(world_from_session)
    cameras = tuple(
        one.model_copy(update={"camera_from_world": _rows(np.array(one.camera_from_world) @ world_from_session)})
        for one in rig.cameras
    )
    lights = tuple(
        one.model_copy(update={"position_mm": tuple((session_from_world @ [*one.position_mm, 1.0])[:3].tolist())})
        for one in rig.lights
    )
    return rig.model_copy(update={"cameras": cameras, "lights": lights})


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def _camera(name: str, planned: Floats, size: RigSize, black: float, random: np.random.Generator) -> CalibratedCamera:
    from scipy.spatial.transform import Rotation

    rotation_error = Rotation.from_rotvec(np.radians(random.normal(0, CAMERA_SD_DEG, 3))).as_matrix()
    rotation = rotation_error @ planned[:3, :3]
    centre = -planned[:3, :3].T @ planned[:3, 3]
    centre = CAMERA_MM * centre / np.linalg.norm(centre) + random.normal(0, CAMERA_SD_MM, 3)
    # Aim the camera at the teeth, as a person who mounts it would do.
    rotation = _aimed(rotation, -centre)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    focal = CAMERA_MM / size.pixel_mm * (1 + FOCAL_SD * random.normal())
    middle = np.array(size.pixels) / 2 + random.normal(0, CENTRE_SD_PX, 2)
    response = WHITE_COUNTS_PER_S * np.array(RESPONSE) * (1 + RESPONSE_SD * random.normal(size=3))
    return CalibratedCamera.model_validate(
        {
            "name": name,
            "size": size.pixels,
            "K": ((focal, 0.0, middle[0]), (0.0, focal * (1 + 0.001 * random.normal()), middle[1]), (0.0, 0.0, 1.0)),
            "distortion": tuple(np.array(LENS) * random.uniform(0.7, 1.3, 4)),
            "camera_from_world": pose.tolist(),
            # Radiance of the diffuser divided by its counts per second.
            "radiance_per_count": (1 / (np.pi * 1e6) / response).tolist(),
            "black_counts": black,
        }
    )


def _aimed(rotation: Floats, forward: Floats) -> Floats:
    """Turn a camera's rotation (3, 3) so that it looks along a direction, and keep its x axis as near as possible."""
    z = forward / np.linalg.norm(forward)
    x = rotation[0] - (rotation[0] @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


class Lens:
    """Distortion of a camera's lens by OpenCV's formulas: pixels to undistorted pixels and rays, points to pixels."""

    def __init__(self, camera: CalibratedCamera) -> None:
        self.camera = camera

    def undistorted(self, pixels: Floats) -> Floats:
        """Undistorted positions (N, 2) of pixels (N, 2) of the photograph."""
        import cv2

        K = np.array(self.camera.K)
        K[:2, 2] -= 0.5  # because OpenCV's pixel centres are whole numbers
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
        points = (np.asarray(pixels, dtype=np.float64) - 0.5).reshape(-1, 1, 2)
        found = cv2.undistortPoints(points, K, np.array(self.camera.distortion), R=np.eye(3), P=K, criteria=criteria)
        return np.asarray(found.reshape(-1, 2) + 0.5)

    def project(self, points_mm: Floats) -> Floats:
        """Pixels (N, 2) of the photograph that show world points (N, 3)."""
        import cv2

        K, pose = np.array(self.camera.K), np.array(self.camera.camera_from_world)
        K[:2, 2] -= 0.5
        rotation_vector = cv2.Rodrigues(pose[:3, :3])[0]
        found = cv2.projectPoints(
            np.asarray(points_mm), rotation_vector, pose[:3, 3], K, np.array(self.camera.distortion)
        )[0]
        return np.asarray(found.reshape(-1, 2) + 0.5)

    def rays(self) -> tuple[Floats, Floats]:
        """Centre (3,) of the camera, and unit directions (H · W, 3) through all pixels' centres."""
        width, height = self.camera.size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        pinhole = self.undistorted(np.stack([x.ravel(), y.ravel()], axis=1))
        return self.camera.rays(pinhole[:, 0], pinhole[:, 1])
