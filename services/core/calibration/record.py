"""The calibration of cameras and lights: as a capture states it, and as a calibration file replaces it."""

from __future__ import annotations

import time
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import Field

from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight, CameraColour, is_absent
from services.core.calibration.colours import colours_among, require_colours
from services.core.calibration.uncertainty import CalibrationUncertainty, require_known_names
from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Record, Vector3
from services.core.records import FolderCapture
from services.core.results import CaptureManifest
from services.core.store import MANIFEST, open_stage, read_record

CALIBRATION_FILE = "calibration.json"
"""Name of the file of a calibration, also among the files of the job that made it."""
RAW_DESCRIPTION = "raw.toml"
"""Name of the file that makes a folder of photographs a capture; see ``services.core.raw``."""
EARLIEST = datetime(1990, 1, 1, tzinfo=UTC)
"""Earliest date of a calibration; cameras wrote no numbers before."""
MAX_LIGHTS = 1000
"""Largest number of lights: six times the lights of the largest dome known to this project."""
MAX_PIXELS = 2**28
"""Largest number of pixels of one camera. The largest single-chip sensors have fewer (151 million), and an image of one
channel still fits into a GiB."""
MAX_FOCAL_PX = 1e7
"""Largest focal length and coordinate of the principal point, pixels. With a longer focal length a pixel is smaller
than light resolves."""
MAX_DISTANCE_MM = 1e6
"""Largest coordinate of a light, and of the translation of a camera's pose, mm: a kilometre. A rig in micrometres does
not come out much nearer."""
MIN_INTENSITY, MAX_INTENSITY = 1e-12, 1e24
"""Smallest and largest intensity of a light. Between them, products with distances and albedos stay within the range of
single precision."""


class CalibrationLimit(Record):
    """One figure that a calibration was held to when it was made."""

    what: str
    value: float | None = Field(description="null where it could not be told at all")
    limit: float
    unit: str

    @property
    def is_kept(self) -> bool:
        """Whether the value is known and within the limit."""
        return self.value is not None and self.value <= self.limit


class Calibration(Record):
    """``calibration.json``: cameras and lights of a rig.

    The part of ``capture.json`` that a rig is calibrated for is one, too.
    """

    units: Literal["mm"]
    channels: tuple[str, ...] = Field(fail_fast=True)
    cameras: tuple[CalibratedCamera, ...] = Field(fail_fast=True)
    lights: tuple[CalibratedLight, ...] = Field(fail_fast=True)
    uncertainty: CalibrationUncertainty | None = Field(
        default=None, description="how wrong the calibration may be; null where that was not measured"
    )
    made: str | None = Field(
        default=None, exclude_if=is_absent, description="date and time of the calibration, ISO 8601"
    )
    valid_days: float | None = Field(default=None, exclude_if=is_absent, gt=0, description="for how long it holds")
    inputs: dict[str, str] | None = Field(
        default=None, exclude_if=is_absent, description="SHA-256 of each file that it was made from"
    )
    colour: dict[str, CameraColour] | None = Field(
        default=None, exclude_if=is_absent, description="colours of each camera by its name; they apply to the asset"
    )
    limits: tuple[CalibrationLimit, ...] | None = Field(
        default=None, exclude_if=is_absent, description="what it was held to; null where it was held to nothing"
    )

    @classmethod
    def of_capture(cls, description: FolderCapture) -> Calibration:
        """The calibration that a capture states of its cameras and lights."""
        parts = {"units", "channels", "cameras", "lights", "uncertainty", "colour"}
        return cls.model_validate(description.model_dump(include=parts))


def published_capture(capture: Path) -> tuple[Path, str] | None:
    """Job folder and stage name of a published capture, or of the job that holds one; None for a folder of images or
    photographs.

    Raises:
        CaptureInputError: the folder is none of these.
    """
    if any((capture / name).is_file() for name in ("capture.json", RAW_DESCRIPTION)) or not capture.is_dir():
        return None
    if (capture / MANIFEST).is_file():
        return capture.parent, capture.name
    if (capture / "capture" / MANIFEST).is_file():
        return capture, "capture"
    if (capture / "slab.json").is_file():
        raise CaptureInputError(f'{capture} holds slab.json, which a job of another kind reads; set kind = "slab".')
    raise CaptureInputError(
        f"{capture} holds neither capture.json, {RAW_DESCRIPTION} nor a published capture; check option 'capture'."
    )


def read_description(capture: Path) -> FolderCapture:
    """Read the description of a folder capture or of a published capture, with its cameras and lights.

    Raises:
        CaptureInputError: the description cannot be read.
    """
    published = published_capture(capture)
    if published is None:
        return read_record(capture / "capture.json", FolderCapture)
    return open_stage(*published, CaptureManifest, verify=False)[1].description


def require_consistent(description: FolderCapture | Calibration, origin: str) -> None:
    """Refuse a description whose names or channels contradict each other.

    Raises:
        CaptureInputError: there is a contradiction; the message names the first one.
    """
    named = {
        "camera": [camera.name for camera in description.cameras],
        "light": [light.name for light in description.lights],
        "channel": list(description.channels),
    }
    for what, names in named.items():
        if not names:
            raise CaptureInputError(f"{origin} lists no {what}; add at least one.")
        if repeated := {name for name, count in Counter(names).items() if count > 1}:
            raise CaptureInputError(f"{origin} lists {what} {min(repeated)} twice; give each its own name.")
    if len(description.lights) > MAX_LIGHTS:
        raise CaptureInputError(
            f"{origin} lists {len(description.lights)} lights, more than any rig has ({MAX_LIGHTS}); remove those"
            " without images."
        )
    for camera in description.cameras:
        _require_possible(camera, origin)
        if isinstance(camera, CalibratedCamera):
            _require_each_channel(camera, len(description.channels), origin)
    for light in description.lights:
        if len(light.intensity) != len(description.channels):
            raise CaptureInputError(
                f"{origin}: light {light.name} has {len(light.intensity)} intensities for {len(description.channels)}"
                " channels; give one per channel."
            )
        dark = [
            channel
            for channel, value in zip(description.channels, light.intensity, strict=True)
            if not MIN_INTENSITY <= value <= MAX_INTENSITY
        ]
        if dark:
            value = light.intensity[description.channels.index(dark[0])]
            what = (
                f"{origin}: light {light.name} has intensity {value:g} in channel {dark[0]}, outside {MIN_INTENSITY:g}"
                f" to {MAX_INTENSITY:g}"
            )
            raise CaptureInputError(f"{what}; give what was measured, or remove the light.")
        if max(map(abs, light.position_mm)) > MAX_DISTANCE_MM:
            raise CaptureInputError(
                f"{origin}: light {light.name} is more than {MAX_DISTANCE_MM:g} mm away; correct position_mm."
            )
    if isinstance(description, FolderCapture):
        require_own_files(description, origin)
    elif description.made is not None:
        require_date(description.made, origin, time.time())
    require_colours(description.colour, tuple(named["camera"]), len(description.channels), origin)
    require_known_names(description.uncertainty, description.channels, description.cameras, description.lights, origin)


def require_own_files(description: FolderCapture, origin: str) -> None:
    """Refuse a capture that names one channel, or one image file, twice.

    Raises:
        CaptureInputError: one is named twice; the message names it, and the camera and light of the second.
    """
    if repeated := {name for name, count in Counter(description.channels).items() if count > 1}:
        raise CaptureInputError(f"{origin} lists channel {min(repeated)} twice; give each its own name.")
    taken: dict[PurePosixPath, str] = {}
    for image in description.images:
        use = f"camera {image.camera} under light {image.light}"
        if (earlier := taken.setdefault(PurePosixPath(image.file), use)) != use:
            raise CaptureInputError(
                f"{origin} names file {image.file} for {earlier} and again for {use}; give each image a file of its"
                " own."
            )
    for image in description.images:
        if image.variance_file is not None and (shown := taken.get(PurePosixPath(image.variance_file))):
            raise CaptureInputError(
                f"{origin} names file {image.variance_file} as the image of {shown} and as a variance; give each a file"
                " of its own."
            )


def require_date(made: str, origin: str, now_s: float) -> None:
    """Refuse a date on which no calibration can have been made.

    Args:
        made: date and time, ISO 8601; without a zone it is taken for UTC.
        now_s: Unix time.

    Raises:
        CaptureInputError: it is no date, or lies before 1990 or more than a day ahead.
    """
    try:
        date = datetime.fromisoformat(made)
    except ValueError as problem:
        raise CaptureInputError(
            f"{origin} says made = {made[:40]!r}, which is no date; give date and time as in 2026-01-31T12:00:00."
        ) from problem
    then = date if date.tzinfo else date.replace(tzinfo=UTC)
    if not EARLIEST <= then <= datetime.fromtimestamp(now_s, UTC) + timedelta(days=1):
        raise CaptureInputError(
            f"{origin} says that it was made on {made[:40]}, which is before 1990 or still to come; correct the date,"
            " and this machine's clock if that is wrong."
        )


def _require_each_channel(camera: CalibratedCamera, channels: int, origin: str) -> None:
    for key in ("radiance_per_count", "crosstalk"):
        value = getattr(camera, key)
        if value is not None and len(value) != channels:
            raise CaptureInputError(
                f"{origin}: camera {camera.name} has {key} of {len(value)} channels, and there are {channels}; give one"
                " per channel."
            )


def _require_possible(camera: Camera, origin: str) -> None:
    """Refuse a camera whose size, intrinsic matrix or pose is impossible in any rig."""
    where = f"{origin}: camera {camera.name}"
    width, height = camera.size
    if width * height > MAX_PIXELS:
        raise CaptureInputError(
            f"{where} has {width} x {height} pixels, more than any camera here ({MAX_PIXELS / 2**20:.0f} million);"
            " correct its size."
        )
    (fx, skew, cx), (zero, fy, cy), last = camera.K
    if not (0 < fx <= MAX_FOCAL_PX and 0 < fy <= MAX_FOCAL_PX):
        what = (
            f"{where} has focal lengths K[0][0] = {fx:g} and K[1][1] = {fy:g} pixels, which must lie between 0 and"
            f" {MAX_FOCAL_PX:g}"
        )
        raise CaptureInputError(f"{what}; correct K.")
    if zero != 0 or last != (0, 0, 1) or abs(skew) > fx or max(abs(cx), abs(cy)) > MAX_FOCAL_PX:
        raise CaptureInputError(
            f"{where} has a K that is not [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in pixels; correct K."
        )
    if max(abs(row[3]) for row in camera.camera_from_world) > MAX_DISTANCE_MM:
        raise CaptureInputError(f"{where} is more than {MAX_DISTANCE_MM:g} mm away; its pose must be in millimetres.")
    if camera.camera_from_world[3] != (0, 0, 0, 1):
        raise CaptureInputError(
            f"{where}: the last row of camera_from_world must be [0, 0, 0, 1]; export the pose again."
        )


def recalibrated(description: FolderCapture, calibration: Calibration, path: Path) -> FolderCapture:
    """The same capture with the cameras and lights of a calibration, matched by name.

    The calibration may have more cameras and lights than the capture.

    Args:
        description: description of the capture.
        calibration: the calibration, read from a file.
        path: path of that file, for messages.

    Raises:
        CaptureInputError: the calibration lacks a camera or light, or is for another image size or other channels.
    """
    require_consistent(calibration, f"Calibration {path}")
    if calibration.channels != description.channels:
        theirs, ours = ", ".join(calibration.channels), ", ".join(description.channels)
        raise CaptureInputError(
            f"Calibration {path} is for channels {theirs}, but the capture has {ours}; choose the calibration of this"
            " rig."
        )
    cameras, lights = (
        {camera.name: camera for camera in calibration.cameras},
        {light.name: light for light in calibration.lights},
    )
    for what, wanted, known in (("camera", description.cameras, cameras), ("light", description.lights, lights)):
        if absent := next((one.name for one in wanted if one.name not in known), None):
            raise CaptureInputError(
                f"Calibration {path} lacks {what} {absent} of the capture; choose the calibration of this rig."
            )
    for camera in description.cameras:
        if cameras[camera.name].size != camera.size:
            theirs, ours = (" x ".join(map(str, size)) for size in (cameras[camera.name].size, camera.size))
            raise CaptureInputError(
                f"Calibration {path} is for images of {theirs} pixels of camera {camera.name}, but the capture's are"
                f" {ours}; calibrate anew."
            )
    changed: dict[str, object] = {
        "cameras": tuple(cameras[one.name] for one in description.cameras),
        "lights": tuple(lights[one.name] for one in description.lights),
        "uncertainty": calibration.uncertainty,
        "colour": colours_among(calibration.colour, (one.name for one in description.cameras)),
    }
    return description.model_copy(update=changed)


def lit_at(description: FolderCapture, point_mm: Vector3) -> FolderCapture:
    """The same capture with the intensities that its lights have towards a point, according to their lobes.

    Raises:
        CaptureInputError: a light shines away from the point.
    """
    lights = [light.towards(point_mm) if isinstance(light, CalibratedLight) else light for light in description.lights]
    if dark := next((light.name for light in lights if not max(light.intensity) > 0), None):
        raise CaptureInputError(
            f"Light {dark} shines away from the teeth, as the lobe of its calibration says; choose the calibration of"
            " this rig."
        )
    return description.model_copy(update={"lights": tuple(lights)})
