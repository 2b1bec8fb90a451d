"""Cameras that see a virtual mouth under the light that the dome really emits, and cameras that play back images."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from services.capture.cameras.motion import SubjectMotion, resample
from services.capture.cameras.stills import Stills
from services.capture.dome.controller import DomeObserver
from services.capture.plan import PlannedFrame
from services.core.errors import RigError
from services.core.records import RigSpec, SimulatedCameraSpec

PEAK_FRACTION = 0.7
"""Fraction of the range above black that the peak radiance reaches."""
RGB_OF_CHANNEL = {"red": 0, "green": 1, "blue": 2, "r": 0, "g": 1, "b": 2}
"""Index of the LED for each name of a channel."""


class SensorModel:
    """Sensor that converts radiance and light to counts.

    ``count = black + level * exposure_s * radiance / radiance_per_count + noise``, rounded and clipped to 0 ..
    2**bits - 1, with noise of variance ``(noise_relative * signal)² + (noise_floor * full scale)²``. The gain puts
    ``peak_radiance`` at 0.7 of the range above black for the rig's level and exposure.
    """

    def __init__(self, spec: SimulatedCameraSpec, peak_radiance: float, level: float, exposure_s: float) -> None:
        self.spec = spec
        self.full_scale = 2**spec.bits - 1
        self.radiance_per_count: float = (
            peak_radiance * level * exposure_s / (PEAK_FRACTION * (self.full_scale - spec.black_level))
        )

    def expose(self, radiance_s: NDArray[np.float32], noise_seed: Sequence[int] | None) -> NDArray[np.uint16]:
        """Counts of an image of level × radiance × seconds; without a seed they have no noise."""
        signal = radiance_s / self.radiance_per_count
        if noise_seed is not None:
            deviation = np.hypot(self.spec.noise_relative * signal, self.spec.noise_floor * self.full_scale)
            signal = signal + deviation * np.random.default_rng([self.spec.seed, *noise_seed]).standard_normal(
                signal.shape, dtype=np.float32
            )
        counts: NDArray[np.uint16] = np.clip(np.rint(self.spec.black_level + signal), 0, self.full_scale).astype(
            np.uint16
        )
        return counts


class SimulatedCameras:
    """``Cameras`` that see only the light in the dome's output registers, over a read-only connection of their own.

    The subject's motion and the noise depend on the frame's number and not on the clock, so that a resumed capture
    equals an undisturbed one.
    """

    def __init__(
        self,
        stills: Stills,
        rig: RigSpec,
        level: float,
        motion: SubjectMotion,
        host: str,
        port: int,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._stills, self._motion, self._address, self._wait = stills, motion, (host, port), wait
        self._sensor = SensorModel(rig.simulation, stills.peak_radiance, level, rig.exposure_s)
        self._rgb = [RGB_OF_CHANNEL.get(channel.lower()) for channel in stills.description.channels]
        self._observer: DomeObserver | None = None
        self._exposure_s, self._frame, self._triggers_before = 0.0, 0, 0

    def __enter__(self) -> Self:
        self._observer = DomeObserver(*self._address)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._observer is not None:
            self._observer.close()

    @property
    def bits(self) -> int:
        """See ``Cameras``."""
        return self._sensor.spec.bits

    @property
    def black_level(self) -> int:
        """See ``Cameras``."""
        return self._sensor.spec.black_level

    @property
    def radiance_per_count(self) -> float:
        """See ``Cameras``."""
        return self._sensor.radiance_per_count

    def arm(self, exposure_s: float, frame: int) -> None:
        """See ``Cameras``."""
        assert self._observer is not None
        self._exposure_s, self._frame, self._triggers_before = exposure_s, frame, self._observer.trigger_count()

    def read(self) -> tuple[NDArray[np.uint16], ...]:
        """See ``Cameras``. The exposure's light is the mean of the levels observed at its start and at its end."""
        assert self._observer is not None
        if self._observer.trigger_count() == self._triggers_before:
            raise RigError(f"The cameras got no trigger for frame {self._frame}; check the trigger line.")
        at_start = self._observer.outputs()
        self._wait(self._exposure_s)
        levels = (at_start + self._observer.outputs()) / 2
        return tuple(self._expose(camera, levels) for camera in range(len(self._stills.description.cameras)))

    def _expose(self, camera: int, levels: NDArray[np.float64]) -> NDArray[np.uint16]:
        height, width, channels = self._stills.shape(camera)
        radiance = np.zeros((height, width, channels), dtype=np.float32)
        # Give a channel that is not red, green or blue the mean of the three LEDs.
        weights = np.stack([levels.mean(axis=1) if rgb is None else levels[:, rgb] for rgb in self._rgb], axis=-1)
        for light in np.flatnonzero(weights[: len(self._stills.description.lights)].any(axis=1)):
            radiance += weights[light].astype(np.float32) * self._stills.still(camera, int(light))
        moved = resample(radiance, self._motion.flow_px(self._frame, camera, height, width))
        return self._sensor.expose(moved * np.float32(self._exposure_s), (camera, self._frame))


class PlaybackCameras:
    """``Cameras`` that play back a folder's images for the planned lights, without motion and noise.

    They do not observe the dome.
    """

    def __init__(
        self,
        stills: Stills,
        rig: RigSpec,
        level: float,
        plan: Sequence[PlannedFrame],
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._stills, self._plan, self._wait = stills, plan, wait
        self._sensor = SensorModel(rig.simulation, stills.peak_radiance, level, rig.exposure_s)
        self._frame = 0
        self.bits = rig.simulation.bits
        self.black_level = rig.simulation.black_level
        self.radiance_per_count = self._sensor.radiance_per_count

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to release."""

    def arm(self, exposure_s: float, frame: int) -> None:  # noqa: ARG002
        """See ``Cameras``."""
        self._frame = frame

    def read(self) -> tuple[NDArray[np.uint16], ...]:
        """See ``Cameras``."""
        planned = self._plan[self._frame]
        self._wait(planned.exposure_s)
        lights = {"black": range(0), "tracking": range(len(self._stills.description.lights))}.get(planned.kind)
        if lights is None:
            assert planned.light is not None
            lights = range(planned.light, planned.light + 1)
        images = []
        for camera in range(len(self._stills.description.cameras)):
            radiance = np.zeros(self._stills.shape(camera), dtype=np.float32)
            for light in lights:
                radiance += np.float32(planned.level) * self._stills.still(camera, light)
            images.append(self._sensor.expose(radiance * np.float32(planned.exposure_s), None))
        return tuple(images)
