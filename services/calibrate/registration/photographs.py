"""Input of registration from a raw folder: one photograph per camera, without lens distortion, and the clicks in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.lens import HALF_PIXEL, Lens
from services.calibrate.registration.landmarks import Click
from services.calibrate.registration.outlines import View
from services.calibrate.registration.pose import Floats, RigidPose
from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.calibration.record import Calibration
from services.core.errors import CaptureInputError
from services.core.geometry import Camera
from services.core.raw.frames import read_counts
from services.core.raw.mosaic import binned
from services.core.raw.records import RawCamera, RawFolder, RawFrame

WIDEST_PX = 2400
"""Largest width of a photograph; wider ones are reduced first. A pixel is then some 0.05 mm at the teeth."""
MAX_CROP_PX = 700
"""Largest width of the part around the teeth in which outlines are searched: a pixel is then 0.1 mm, and edges are
located to a fraction of it."""
MARGIN_MM = 4.0
"""Margin around the teeth in that part."""
MAX_LIGHTS = 12
"""Largest number of frames of single lights that are averaged where no frame has all lights on."""


def photographs(root: Path, folder: RawFolder, calibration: Calibration) -> dict[str, View]:
    """Return photographs of the teeth by camera, without lens distortion: under all lights, or the mean over some
    lights.

    Raises:
        CaptureInputError: a camera is not calibrated, is calibrated for another image size, or has no frame of the
            teeth.
    """
    views = {}
    for raw in folder.camera:
        camera = _calibrated(calibration, raw.name, raw.size)
        views[raw.name] = _undistorted(mean_photograph(root, folder, raw.name, camera.black_counts), camera)
    return views


def mean_photograph(root: Path, folder: RawFolder, name: str, black: float | None = None) -> NDArray[np.float32]:
    """Return one camera's photograph of the teeth under all lights, or the mean over some lights, with lens distortion.

    Args:
        root: folder of ``raw.toml``.
        folder: content of ``raw.toml``.
        name: name of the camera.
        black: its black level in counts; None to read it from a black frame.

    Returns:
        Counts above black, divided by exposure in seconds and gain (H, W, C); of half the size for a mosaic of at least
        twice ``WIDEST_PX``.

    Raises:
        CaptureInputError: the camera has no frame of the teeth.
    """
    frames = folder.frames_of(name, "tracking")[:1] or _spread_selection(folder.frames_of(name, "light"))
    if not frames:
        raise CaptureInputError(
            f"Camera {name} has no frame of kind tracking or light; add one that shows the teeth, or remove the camera."
        )
    level = _black_counts(root, folder, name) if black is None else black
    images = [_image(root, folder, frame, level) for frame in frames]
    return np.asarray(np.mean(images, axis=0), dtype=np.float32)


def clicks_of(folder: RawFolder, calibration: Calibration, views: Mapping[str, View]) -> list[Click]:
    """Return the clicks of a raw folder's landmarks, with pixels of the undistorted and reduced images of the views."""
    clicks = []
    for landmark in folder.landmark:
        for click in landmark.pixels:
            camera = _calibrated(calibration, click.camera, folder.camera_named(click.camera).size)
            direction = _lens(camera).undistort(np.array([click.xy_px], dtype=np.float64))
            pixel = direction @ np.asarray(views[click.camera].camera.K).T
            name = f"{landmark.tooth} {landmark.point}"
            clicks.append(Click(name, click.camera, np.array(landmark.xyz_mm), pixel[0, :2] / pixel[0, 2]))
    return clicks


def crop_to_points(view: View, points_mm: Floats) -> View:
    """Crop a photograph to points of the rig (N, 3) with a margin, and reduce it to at most ``MAX_CROP_PX`` in width.

    Raises:
        CaptureInputError: the points do not lie in the photograph.
    """
    import cv2

    camera = view.camera
    pixels, depth = camera.project(points_mm)
    margin = MARGIN_MM / camera.pixel_mm(points_mm.mean(axis=0))
    low = np.maximum(np.floor(pixels.min(axis=0) - margin), 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0) + margin), camera.size).astype(int)
    if (depth <= 0).any() or (high - low < 16).any():
        raise CaptureInputError(
            f"The landmarks put the teeth beside the picture of camera {camera.name}; correct them, or the camera's"
            " pose."
        )
    part = view.image[low[1] : high[1], low[0] : high[0]]
    scale = min(1.0, MAX_CROP_PX / part.shape[1])
    size = (max(round(part.shape[1] * scale), 1), max(round(part.shape[0] * scale), 1))
    small = part if scale == 1 else cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    by = np.array(size) / np.array(part.shape[1::-1])
    (fx, skew, cx), (_, fy, cy), last = camera.K
    K = ((fx * by[0], skew * by[0], (cx - low[0]) * by[0]), (0.0, fy * by[1], (cy - low[1]) * by[1]), last)
    return View(
        Camera(name=camera.name, size=size, K=K, camera_from_world=camera.camera_from_world), _with_channels(small)
    )


def require_facing(cameras: Sequence[Camera], pose: RigidPose, arch_from_scan: Floats, centre_mm: Floats) -> None:
    """Refuse a pose in which no camera sees the front or the chewing side of the teeth.

    Args:
        cameras: all cameras.
        pose: pose of the scan in the rig.
        arch_from_scan: transform (4, 4) from the scan to the dental arch's axes.
        centre_mm: centre of the teeth in the scan (3,).

    Raises:
        CaptureInputError: no camera sees the front or the chewing side.
    """
    centre, axes = pose.apply(centre_mm[None])[0], arch_from_scan[:3, :3] @ pose.rotation.T
    for camera in cameras:
        camera_from_world = np.asarray(camera.camera_from_world)
        to_camera = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3] - centre
        if max(axes[1] @ to_camera, axes[2] @ to_camera) > 0:
            return
    raise CaptureInputError(
        "The landmarks turn the teeth's back and their roots to every camera; exchange left and right, or give the"
        " other jaw's scan."
    )


def _calibrated(calibration: Calibration, name: str, size: tuple[int, int]) -> CalibratedCamera:
    found = next((camera for camera in calibration.cameras if camera.name == name), None)
    if found is None:
        known = ", ".join(camera.name for camera in calibration.cameras)
        raise CaptureInputError(
            f"Camera {name} of the raw folder is not in the calibration, which has {known}; calibrate it or correct its"
            " name."
        )
    if found.size != size:
        theirs, ours = (" x ".join(map(str, one)) for one in (found.size, size))
        raise CaptureInputError(
            f"The calibration is for images of {theirs} pixels of camera {name}, but the raw folder's are {ours};"
            " calibrate anew."
        )
    return found


def _lens(camera: CalibratedCamera) -> Lens:
    (fx, _, cx), (_, fy, cy), _ = camera.K
    return Lens(camera.size, np.array([fx, fy, cx, cy, *(camera.distortion or ())]))


def _spread_selection(frames: Sequence[RawFrame]) -> Sequence[RawFrame]:
    count = min(len(frames), MAX_LIGHTS)
    return [frames[k * len(frames) // count] for k in range(count)]


def _black_counts(root: Path, folder: RawFolder, name: str) -> float:
    frames = folder.frames_of(name, "black")
    return float(read_counts(root, folder, frames[0]).mean()) if frames else 0.0


def _image(root: Path, folder: RawFolder, frame: RawFrame, black: float) -> NDArray[np.float32]:
    counts: NDArray[Any] = read_counts(root, folder, frame)
    camera = folder.camera_named(frame.camera)
    image = counts.astype(np.float32) if camera.mosaic == "none" else _colours(counts, camera)
    return np.asarray((_with_channels(image) - black) / (frame.exposure_s * frame.gain), dtype=np.float32)


def _colours(counts: NDArray[Any], camera: RawCamera) -> NDArray[np.float32]:
    """Return a mosaic's interpolated image (H, W, 3), or one of half the size where its width is ``WIDEST_PX`` then."""
    import cv2

    if camera.size[0] >= 2 * WIDEST_PX:
        return binned(counts, camera.mosaic)
    return np.asarray(cv2.cvtColor(counts, getattr(cv2, f"COLOR_Bayer{camera.mosaic}2RGB")), dtype=np.float32)


def _undistorted(image: NDArray[np.float32], camera: CalibratedCamera) -> View:
    import cv2

    # Reduce the size before the distortion is removed.
    scale = min(image.shape[1], WIDEST_PX) / image.shape[1]
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small = image if scale == 1 else _with_channels(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    by = np.array(size) / np.array(camera.size)
    (fx, skew, cx), (_, fy, cy), last = camera.K
    K = ((fx * by[0], skew * by[0], cx * by[0]), (0.0, fy * by[1], cy * by[1]), last)
    if camera.distortion is not None:
        # OpenCV's pixel centres lie at integers.
        own = np.array(K)
        own[:2, 2] -= HALF_PIXEL
        small = _with_channels(cv2.undistort(small, own, np.array(camera.distortion)))
    return View(Camera(name=camera.name, size=size, K=K, camera_from_world=camera.camera_from_world), small)


def _with_channels(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return image[..., None] if image.ndim == 2 else image


def cameras_of(views: Mapping[str, View]) -> dict[str, Camera]:
    """Return the cameras of photographs, by name."""
    return {name: view.camera for name, view in views.items()}
