"""Where cameras and lights are: what a capture says of it, and what may stand in for that."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light, Record
from services.core.records import CaptureManifest, FolderCapture
from services.core.store import MANIFEST, open_stage, read_record


class Calibration(Record):
    """The part of ``capture.json`` that a rig is calibrated for."""

    units: Literal["mm"]
    channels: tuple[str, ...]
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]


def published_capture(capture: Path) -> tuple[Path, str] | None:
    """Job folder and stage name of a published capture, or of the job that holds one; None for a folder capture.

    Raises:
        CaptureInputError: it is neither.
    """
    if (capture / "capture.json").is_file() or not capture.is_dir():
        return None
    if (capture / MANIFEST).is_file():
        return capture.parent, capture.name
    if (capture / "capture" / MANIFEST).is_file():
        return capture, "capture"
    raise CaptureInputError(f"{capture} holds neither capture.json nor a published capture; check option 'capture'.")


def read_description(capture: Path) -> FolderCapture:
    """What a folder capture or a published one says of its cameras and lights.

    Raises:
        CaptureInputError: it cannot be read.
    """
    published = published_capture(capture)
    if published is None:
        return read_record(capture / "capture.json", FolderCapture)
    return open_stage(*published, CaptureManifest, verify=False)[1].description


def require_consistent(description: FolderCapture | Calibration, origin: str) -> None:
    """Refuse a description whose names or channels contradict each other.

    Raises:
        CaptureInputError: names the first contradiction.
    """
    for what, names in (("camera", [c.name for c in description.cameras]), ("light", [light.name for light in description.lights])):
        if not names:
            raise CaptureInputError(f"{origin} lists no {what}; add at least one.")
        repeated = {name for name in names if names.count(name) > 1}
        if repeated:
            raise CaptureInputError(f"{origin} lists {what} {min(repeated)} twice; give each its own name.")
    if not description.channels:
        raise CaptureInputError(f"{origin} lists no channel; name each colour channel of the images.")
    for light in description.lights:
        if len(light.intensity) != len(description.channels):
            raise CaptureInputError(
                f"{origin}: light {light.name} has {len(light.intensity)} intensities for {len(description.channels)} channels; give one per channel."
            )


def recalibrated(description: FolderCapture, path: Path) -> FolderCapture:
    """The same capture with cameras and lights, by name, of a calibration's file; it may have more of them than the capture.

    Raises:
        CaptureInputError: it lacks a camera or light, or is of another image size or other channels.
    """
    calibration = read_record(path, Calibration)
    require_consistent(calibration, f"Calibration {path}")
    if calibration.channels != description.channels:
        theirs, ours = ", ".join(calibration.channels), ", ".join(description.channels)
        raise CaptureInputError(f"Calibration {path} is for channels {theirs}, but the capture has {ours}; choose the calibration of this rig.")
    cameras, lights = {camera.name: camera for camera in calibration.cameras}, {light.name: light for light in calibration.lights}
    for what, wanted, known in (("camera", description.cameras, cameras), ("light", description.lights, lights)):
        if absent := next((one.name for one in wanted if one.name not in known), None):
            raise CaptureInputError(f"Calibration {path} lacks {what} {absent} of the capture; choose the calibration of this rig.")
    for camera in description.cameras:
        if cameras[camera.name].size != camera.size:
            theirs, ours = (" x ".join(map(str, size)) for size in (cameras[camera.name].size, camera.size))
            raise CaptureInputError(
                f"Calibration {path} is for images of {theirs} pixels of camera {camera.name}, but the capture's are {ours}; calibrate anew."
            )
    changed = {"cameras": tuple(cameras[one.name] for one in description.cameras), "lights": tuple(lights[one.name] for one in description.lights)}
    return description.model_copy(update=changed)
