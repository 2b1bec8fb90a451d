"""The cameras and lights of a capture, from a raw folder together with its calibration."""

from __future__ import annotations

from pathlib import Path

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.calibration.colours import colours_among
from services.core.calibration.record import Calibration, read_description, require_consistent
from services.core.errors import CaptureInputError
from services.core.raw.folder import DESCRIPTION, is_raw_folder, read_raw_folder
from services.core.raw.records import RawFolder
from services.core.raw.registration import with_registration
from services.core.records import FolderCapture
from services.core.store import read_record


def read_any_description(capture: Path) -> FolderCapture:
    """Read the description of a capture of any form, with its cameras and lights.

    Raises:
        CaptureInputError: the description cannot be read, or the capture is a raw folder without a calibration of its
            own.
    """
    if not is_raw_folder(capture):
        return read_description(capture)
    folder = read_raw_folder(capture)
    return described(capture, folder, read_calibration(capture, folder, None))


def read_calibration(root: Path, folder: RawFolder, chosen: Path | None) -> Calibration:
    """The calibration of a raw folder's cameras.

    Args:
        chosen: path of the calibration that a job names, in place of the folder's own.

    Raises:
        CaptureInputError: there is no calibration, it lacks a camera or a camera's radiance_per_count, or it is for
            other image sizes or channels.
    """
    if chosen is None and folder.calibration is None:
        raise CaptureInputError(
            f"{root / DESCRIPTION} names no calibration, so where its cameras and lights are is unknown; "
            "add [calibration] file, or give the job one by its option 'calibration'."
        )
    path = chosen if chosen is not None else root / (folder.calibration.file if folder.calibration else "")
    calibration = read_record(path, Calibration)
    require_consistent(calibration, f"Calibration {path}")
    cameras: dict[str, CalibratedCamera] = {camera.name: camera for camera in calibration.cameras}
    for camera in folder.camera:
        if (own := cameras.get(camera.name)) is None:
            raise CaptureInputError(
                f"Calibration {path} lacks camera {camera.name} of {root}; choose the calibration of this rig."
            )
        if own.size != camera.size:
            theirs, ours = (" x ".join(map(str, size)) for size in (own.size, camera.size))
            raise CaptureInputError(
                f"Calibration {path} is for images of {theirs} pixels of camera {camera.name}, but {root} has {ours};"
                " calibrate anew."
            )
        if own.radiance_per_count is None:
            raise CaptureInputError(
                f"Calibration {path} does not say radiance_per_count of camera {camera.name}, so its counts have no"
                " scale; calibrate the lights by a white sphere, or add it by hand."
            )
    if calibration.channels != folder.channels:
        theirs, ours = ", ".join(calibration.channels), ", ".join(folder.channels)
        raise CaptureInputError(
            f"Calibration {path} is for channels {theirs}, but {root} has {ours}; choose that of this rig."
        )
    return calibration


def described(root: Path, folder: RawFolder, calibration: Calibration, teeth_root: Path | None = None) -> FolderCapture:
    """Describe a raw folder's cameras, and the lights of its frames, by the calibration; no image is listed.

    Args:
        teeth_root: folder of the teeth and of their registration; the raw folder by default.

    Raises:
        CaptureInputError: no frame is lit, or a frame is lit by a light that is not calibrated.
    """
    lit = {frame.light for frame in folder.frame if frame.kind == "light"}
    if not lit:
        raise CaptureInputError(f"{root / DESCRIPTION} lists no frame of kind light; add the photographs of the teeth.")
    known = {light.name: light for light in calibration.lights}
    if absent := [light.name for light in folder.light if light.name in lit and light.name not in known]:
        file = next(frame.file for frame in folder.frame if frame.light == absent[0])
        raise CaptureInputError(
            f"The calibration of {root} lacks light {absent[0]}, under which frame {file} was taken; choose that of"
            " this rig."
        )
    by_name = {camera.name: camera for camera in calibration.cameras}
    return FolderCapture(
        units="mm",
        channels=folder.channels,
        cameras=tuple(by_name[camera.name] for camera in folder.camera),
        lights=tuple(known[light.name] for light in folder.light if light.name in lit),
        uncertainty=with_registration(teeth_root or root, calibration.uncertainty),
        colour=colours_among(calibration.colour, (camera.name for camera in folder.camera)),
        subject=folder.subject,
        consent=folder.consent,
    )
