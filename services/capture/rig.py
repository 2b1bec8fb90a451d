"""A rig with checked input: its description, its planned frames, and access to its dome and cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from services.capture.cameras.motion import SubjectMotion
from services.capture.cameras.protocol import Cameras
from services.capture.cameras.simulated import PlaybackCameras, SimulatedCameras
from services.capture.cameras.stills import Stills
from services.capture.dome.address import dome_address
from services.capture.dome.driver import ModbusDome
from services.capture.dome.flashes import Flashes
from services.capture.dome.protocol import ExposureBudget
from services.capture.plan import PlannedFrame, plan_capture, preflight_frames, require_exposure
from services.core.calibration.record import require_consistent
from services.core.choices import chosen
from services.core.errors import CaptureInputError, RigError, SettingsError
from services.core.light.safety import FlashAcknowledgement, unassessed
from services.core.records import FolderCapture, RigSpec, SimulatedCameraSpec
from services.core.store import read_record

MAX_MOTION_PX = 1000.0
"""Largest motion of the simulated subject, pixels; far beyond what the preparation can stabilise."""


@dataclass(frozen=True)
class PlannedRig:
    """A rig with checked input and planned frames; no light is on yet.

    Attributes:
        spec: the rig's options.
        description: cameras, lights and channels.
        plan: frames of the capture, in order.
        stills: images of the virtual mouth.
    """

    spec: RigSpec
    description: FolderCapture
    plan: tuple[PlannedFrame, ...]
    stills: Stills

    @classmethod
    def read(cls, spec: RigSpec) -> PlannedRig:
        """Read the rig's calibration and plan its frames.

        Raises:
            CaptureInputError: the mouth folder is incomplete or contradictory. SettingsError, ExposureLimitError: the
                frames cannot be planned.
        """
        description = _read_description(spec.mouth / "capture.json")
        _require_sensor(spec.simulation)
        limits = spec.light_exposure_limit_s, spec.total_exposure_limit_s
        if not spec.is_simulated and (lacking := unassessed(*limits, spec.assessment)):
            raise SettingsError(f"rig.{lacking}.")
        lights = len(description.lights)
        plan = plan_capture(spec, lights)
        # Count the preflight's dose too; otherwise a capture could reach the limit before its last frames.
        require_exposure((*preflight_frames(plan), *plan), lights, spec)
        return cls(spec, description, plan, Stills(spec.mouth, description))

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights, by their indices in the dome."""
        return tuple(light.name for light in self.description.lights)

    @contextmanager
    def in_use(
        self,
        spent_s: dict[int, float] | None = None,
        before_flashes: Callable[[FlashAcknowledgement], None] = lambda _: None,
        *,
        is_simulated: bool = False,
    ) -> Iterator[tuple[ModbusDome, Cameras]]:
        """Connect to the dome and the cameras for a block; the dome is dark at its end.

        Args:
            spent_s: dose of each light so far, in level-seconds; emitted light is added to it.
            before_flashes: called before the first light under an acknowledgement of a higher rate of flashes.
            is_simulated: the dome is a simulated one, also where the rig gives its address.

        Raises:
            RigError: the dome does not answer, or has too few lights. SettingsError: its address is invalid.
        """
        spec = self.spec
        with dome_address(spec.dome, len(self.lights), spec.watchdog_s) as (host, port):
            budget = ExposureBudget(
                spec.light_exposure_limit_s, spec.total_exposure_limit_s, {} if spent_s is None else spent_s
            )
            flashes = (
                Flashes.of_no_real_light()
                if is_simulated or spec.is_simulated
                else Flashes(spec.flashes, before_first=before_flashes)
            )
            with ModbusDome(host, port, budget, spec.watchdog_s, flashes) as dome:
                if dome.light_count < len(self.lights):
                    listing = f"{spec.mouth / 'capture.json'} lists {len(self.lights)}"
                    raise RigError(
                        f"The dome at {dome.address} has {dome.light_count} lights and {listing}; correct rig.dome."
                    )
                with self._cameras(host, port, dome.pause) as cameras:
                    yield dome, cameras

    def _cameras(self, host: str, port: int, wait: Callable[[float], None]) -> PlaybackCameras | SimulatedCameras:
        spec, plan = self.spec, self.plan
        level = next(frame.level for frame in plan if frame.kind == "light")

        def playback() -> PlaybackCameras:
            return PlaybackCameras(self.stills, spec, level, plan, wait)

        def simulated() -> SimulatedCameras:
            motion = SubjectMotion(
                spec.simulation.motion_px, reference=spec.black_frames, last=len(plan) - 1, seed=spec.simulation.seed
            )
            return SimulatedCameras(self.stills, spec, level, motion, host, port, wait)

        kinds: dict[str, Callable[[], PlaybackCameras | SimulatedCameras]] = {
            "playback": playback,
            "simulated": simulated,
        }
        return chosen("rig.cameras", spec.cameras, kinds)()


def _require_sensor(sensor: SimulatedCameraSpec) -> None:
    """Refuse impossible options of a simulated sensor.

    Raises:
        SettingsError: an option is out of its range; the message names it.
    """
    full_scale = 2**sensor.bits - 1
    if not 0 <= sensor.black_level < full_scale / 2:
        what = (
            f"rig.simulation.black_level {sensor.black_level} does not lie between 0 and half of the {full_scale}"
            f" counts of {sensor.bits} bits"
        )
        raise SettingsError(f"{what}; lower it.")
    if not 0 <= sensor.seed < 2**63:
        raise SettingsError(f"rig.simulation.seed {sensor.seed} is no seed; give a whole number from 0 to 2**63 - 1.")
    if sensor.motion_px > MAX_MOTION_PX:
        raise SettingsError(
            f"rig.simulation.motion_px {sensor.motion_px:g} is more than {MAX_MOTION_PX:g} pixels, which no subject"
            " moves; lower it."
        )


def _read_description(path: Path) -> FolderCapture:
    description = read_record(path, FolderCapture)
    parts = {
        "camera": [c.name for c in description.cameras],
        "light": [light.name for light in description.lights],
        "channel": list(description.channels),
    }
    for part, names in parts.items():
        if not names:
            raise CaptureInputError(f"{path} lists no {part}; describe the rig in it.")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise CaptureInputError(f"{path} lists {part} '{twice}' twice; give each its own name.")
    require_consistent(description, str(path))
    return description
