"""A raw folder as a capture to prepare: its frames become radiance, one camera and light at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibrated import CalibratedCamera
from services.core.calibration import Calibration, require_consistent
from services.core.errors import CaptureInputError
from services.core.files.meshes import fdi_numbers
from services.core.raw.folder import DESCRIPTION, read_raw_folder
from services.core.raw.records import RawFolder, RawFrame
from services.core.records import FolderCapture, FrameRecord
from services.core.store import read_record
from services.preprocess.motion import ViewMotion, frames_to_match, jaws
from services.preprocess.raw.camera import CameraFrames
from services.preprocess.raw.checks import missing_exposures
from services.preprocess.raw.view import RawView
from services.preprocess.rig import MIN_TRACKING
from services.preprocess.source import LightImage, Motions, View


class RawSource:
    """Reads a raw folder with the calibration of its rig."""

    held_out: tuple[tuple[str, str], ...] = ()
    measures_motion = True

    def __init__(self, root: Path, calibration: Path | None, noise_relative: float, noise_floor: float) -> None:
        """Read the description and the calibration; no pixel is read yet.

        Args:
            calibration: that of the job, in place of the folder's own.
            noise_relative: assumed noise where nothing tells it, fraction of the value.
            noise_floor: and of full scale.

        Raises:
            CaptureInputError: names what is missing or contradictory.
        """
        self.root, self._noise = root, (noise_relative, noise_floor)
        self._measured: dict[str, CameraFrames] = {}
        self._folder = read_raw_folder(root)
        self._calibration = _read_calibration(root, self._folder, calibration)
        self._cameras = {camera.name: camera for camera in self._calibration.cameras}
        self.description = _description(root, self._folder, self._calibration)
        self._frames = _in_time(frame for frame in self._folder.frame if frame.kind in {"light", "tracking"})
        self.notes: tuple[str, ...] = tuple(missing_exposures(self._folder))
        fewest = min(sum(frame.kind == "tracking" for frame in self._of(camera.name)) for camera in self._folder.camera)
        if fewest < MIN_TRACKING:
            told = f"A camera has {fewest} tracking frames, and {MIN_TRACKING} are needed to follow a smooth motion to 0.2 px"
            self.notes += (f"{told}; take one with all lights on after every few lights.",)

    def lights_of(self, camera: int) -> tuple[int, ...]:
        """See ``Source``."""
        lit = {frame.light for frame in self._of(self.description.cameras[camera].name) if frame.kind == "light"}
        return tuple(k for k, light in enumerate(self.description.lights) if light.name in lit)

    def identity(self) -> str:
        """See ``Source``: every frame's size and time of change, so that one that was exported again counts."""
        lines = [self.description.model_dump_json(), self._folder.model_dump_json(), repr(self._noise)]
        lines.append(self._calibration.model_dump_json())
        paths = [path for frame in self._folder.frame if (path := self.root / frame.file).is_file()]
        lines += [f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in paths]
        return "\n".join(lines)

    def matched(self, camera: int) -> tuple[int, ...]:
        """See ``Source``."""
        return tuple(row.index for row in frames_to_match(self._table(self.description.cameras[camera].name)))

    def match(self, view: View, frames: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """See ``Source``."""
        raw, taken = self._raw_view(view), self._of(view.whole.name)
        return raw.motion.measure(frames, lambda row: raw.brightness(taken[row.index]))

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:
        """See ``Source``: the exposures of one light at a time, merged."""
        raw, taken = self._raw_view(view), self._of(view.whole.name)
        table = self._table(view.whole.name)
        for light in lights:
            name = self.description.lights[light].name
            own = [k for k, frame in enumerate(taken) if frame.light == name]
            moves = [raw.motion.at(table[k], motions) for k in own]
            yield light, raw.image([taken[k] for k in own], moves)

    def _raw_view(self, view: View) -> RawView:
        name = view.whole.name
        if name not in self._measured:
            self._measured[name] = CameraFrames(self.root, self._folder, self._cameras[name], self._noise)
            self.notes += tuple(self._measured[name].notes)
        motion = ViewMotion(view, jaws(fdi_numbers(self.root)), self._table(name))
        return RawView(self.root, self._measured[name], view, motion, self.description.channels)

    def _table(self, camera: str) -> list[FrameRecord]:
        return [_row(index, frame) for index, frame in enumerate(self._of(camera))]

    def _of(self, camera: str) -> list[RawFrame]:
        return [frame for frame in self._frames if frame.camera == camera]


def _row(index: int, frame: RawFrame) -> FrameRecord:
    kind = "tracking" if frame.kind == "tracking" else "light"
    return FrameRecord(
        index=index,
        kind=kind,  # type: ignore[arg-type]
        light=frame.light,
        exposure_s=frame.exposure_s,
        level=frame.level,
        time_s=frame.time_s or 0.0,
        readback=(0, 0, 0),
    )


def _in_time(frames: Iterator[RawFrame]) -> list[RawFrame]:
    """In the order in which they were taken: by their times where all have one, else as they are listed."""
    listed = list(frames)
    if any(frame.time_s is None for frame in listed):
        return listed
    return sorted(listed, key=lambda frame: frame.time_s or 0.0)


def _read_calibration(root: Path, folder: RawFolder, chosen: Path | None) -> Calibration:
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
                f"Calibration {path} is for images of {theirs} pixels of camera {camera.name}, but {root} has {ours}; calibrate anew."
            )
        if own.radiance_per_count is None:
            raise CaptureInputError(
                f"Calibration {path} does not say radiance_per_count of camera {camera.name}, so its counts have no scale; "
                "calibrate the lights by a white sphere, or add it by hand."
            )
    if calibration.channels != folder.channels:
        theirs, ours = ", ".join(calibration.channels), ", ".join(folder.channels)
        raise CaptureInputError(
            f"Calibration {path} is for channels {theirs}, but {root} has {ours}; choose that of this rig."
        )
    return calibration


def _description(root: Path, folder: RawFolder, calibration: Calibration) -> FolderCapture:
    """The cameras and those lights that frames were taken under, with the calibration's places."""
    lit = {frame.light for frame in folder.frame if frame.kind == "light"}
    if not lit:
        raise CaptureInputError(f"{root / DESCRIPTION} lists no frame of kind light; add the photographs of the teeth.")
    known = {light.name: light for light in calibration.lights}
    if absent := [light.name for light in folder.light if light.name in lit and light.name not in known]:
        file = next(frame.file for frame in folder.frame if frame.light == absent[0])
        raise CaptureInputError(
            f"The calibration of {root} lacks light {absent[0]}, under which frame {file} was taken; choose that of this rig."
        )
    by_name = {camera.name: camera for camera in calibration.cameras}
    return FolderCapture(
        units="mm",
        channels=folder.channels,
        cameras=tuple(by_name[camera.name] for camera in folder.camera),
        lights=tuple(known[light.name] for light in folder.light if light.name in lit),
        uncertainty=calibration.uncertainty,
    )
