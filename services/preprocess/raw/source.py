"""A raw folder as a source: its frames become radiance, one camera and light at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.files.meshes import fdi_numbers
from services.core.geometry import OBJECT
from services.core.raw.description import described, read_calibration
from services.core.raw.folder import read_raw_folder
from services.core.raw.records import RawFrame
from services.core.records import Motion
from services.core.results import FrameRecord
from services.preprocess.captures.rig import MIN_TRACKING
from services.preprocess.raw.camera import CameraFrames
from services.preprocess.raw.checks import missing_exposures
from services.preprocess.raw.view import RawView
from services.preprocess.stabilisation.motion import Scene, ViewMotion, frames_to_match, group_exposures, jaws
from services.preprocess.views.flow_comparison import FlowComparison
from services.preprocess.views.source import FootprintIn, LightImage, MatchedFrame, Motions, View


class RawSource:
    """Reader of a raw folder with the calibration of its rig."""

    held_out: tuple[tuple[str, str], ...] = ()
    measures_motion = True

    def __init__(
        self,
        frames_root: Path,
        calibration: Path | None,
        noise_relative: float,
        noise_floor: float,
        teeth_root: Path | None = None,
        memory_bytes: float = np.inf,
        motion: Motion = "auto",
    ) -> None:
        """Read the description and the calibration; no pixel is read yet.

        Args:
            frames_root: the raw folder.
            calibration: the job's calibration, which replaces the folder's own; None for the folder's own.
            noise_relative: standard deviation as a fraction of the value, assumed if the noise is not measured.
            noise_floor: standard deviation as a fraction of full scale, assumed likewise.
            teeth_root: folder of the teeth; None for the raw folder.
            memory_bytes: largest memory that this process may use to make images.
            motion: how the subject's motion is found.

        Raises:
            CaptureInputError: an entry is missing or contradicts another; the message names it.
        """
        self.root = teeth_root or frames_root
        self._frames_root, self._noise = frames_root, (noise_relative, noise_floor)
        self._memory_bytes = memory_bytes
        self._how: Motion = motion
        self._measured: dict[str, CameraFrames] = {}
        self._folder = read_raw_folder(frames_root)
        self.calibration = read_calibration(frames_root, self._folder, calibration)
        self._cameras = {camera.name: camera for camera in self.calibration.cameras}
        self.description = described(frames_root, self._folder, self.calibration, self.root)
        self._frames = _sorted_by_time(frame for frame in self._folder.frame if frame.kind in {"light", "tracking"})
        self.notes: tuple[str, ...] = tuple(missing_exposures(self._folder))
        fewest = min(
            sum(frame.kind == "tracking" for frame in self._frames_of(camera.name)) for camera in self._folder.camera
        )
        if fewest < MIN_TRACKING and motion != "off":
            shortage = (
                f"A camera has {fewest} tracking frames, and {MIN_TRACKING} are needed to follow a smooth motion to"
                " 0.2 px"
            )
            remedy = "take one with all lights on after every few lights, or give motion = 'off' for what cannot move"
            self.notes += (f"{shortage}; {remedy}.",)

    def lights_of(self, camera: int) -> tuple[int, ...]:
        """See ``Source``."""
        lit = {frame.light for frame in self._frames_of(self.description.cameras[camera].name) if frame.kind == "light"}
        return tuple(k for k, light in enumerate(self.description.lights) if light.name in lit)

    def identity(self) -> str:
        """See ``Source``. It includes every frame's size and modification time, so a new export changes it."""
        lines = [self.description.model_dump_json(), self._folder.model_dump_json(), repr(self._noise)]
        lines.append(self.calibration.model_dump_json())
        paths = [path for frame in self._folder.frame if (path := self._frames_root / frame.file).is_file()]
        lines += [f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in paths]
        return "\n".join(lines)

    def matched_frames(self, camera: int) -> tuple[int, ...]:
        """See ``Source``."""
        table = self._table(self.description.cameras[camera].name)
        return tuple(row.index for row in frames_to_match(table, self._how))

    def match(self, view: View, frames: Sequence[int], footprint_in: FootprintIn) -> Iterator[tuple[int, MatchedFrame]]:
        """See ``Source``."""
        raw, taken = self._raw_view(view), self._frames_of(view.whole.name)
        together = {own[0].index: own for own in group_exposures(self._table(view.whole.name)) if own[0].light}

        def picture(row: FrameRecord) -> NDArray[np.float32]:
            return raw.brightness([taken[one.index] for one in together.get(row.index, (row,))])

        return raw.motion.measure(frames, picture, Scene(self.description.lights, footprint_in))

    def flow_comparison(self, view: View, motions: Motions) -> FlowComparison | None:
        """See ``Source``."""
        raw, taken = self._raw_view(view), self._frames_of(view.whole.name)
        return raw.motion.flow_comparison(lambda row: raw.brightness([taken[row.index]]), motions)

    def images(self, view: View, lights: Sequence[int], motions: Motions) -> Iterator[tuple[int, LightImage]]:
        """See ``Source``. The exposures of each light are merged."""
        raw, taken = self._raw_view(view), self._frames_of(view.whole.name)
        table = self._table(view.whole.name)
        for light in lights:
            name = self.description.lights[light].name
            own = [k for k, frame in enumerate(taken) if frame.light == name]
            moves = [raw.motion.at(table[k], motions) for k in own]
            yield light, raw.image([taken[k] for k in own], moves)

    def _raw_view(self, view: View) -> RawView:
        name = view.whole.name
        if name not in self._measured:
            self._measured[name] = CameraFrames(
                self._frames_root, self._folder, self._cameras[name], self._noise, view.scratch
            )
            self.notes += tuple(self._measured[name].notes)
        motion = ViewMotion(view, jaws(fdi_numbers(self.root) or (OBJECT,)), self._table(name), self._how)
        return RawView(
            self._frames_root, self._measured[name], view, motion, self.description.channels, self._memory_bytes
        )

    def _table(self, camera: str) -> list[FrameRecord]:
        return [_row(index, frame) for index, frame in enumerate(self._frames_of(camera))]

    def _frames_of(self, camera: str) -> list[RawFrame]:
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


def _sorted_by_time(frames: Iterator[RawFrame]) -> list[RawFrame]:
    """Sort frames by the time at which they were taken; if one has no time, keep the order of the list."""
    listed = list(frames)
    if any(frame.time_s is None for frame in listed):
        return listed
    return sorted(listed, key=lambda frame: frame.time_s or 0.0)
