"""A driver of a dome whose controller is its model in this process, on a clock that moves only when something takes
time. Every time that light goes on is recorded.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.capture.dome import registers as reg
from services.capture.dome.driver import ModbusDome
from services.capture.dome.flashes import Flashes
from services.capture.dome.modbus_link import NoReplyError, RefusedError
from services.capture.dome.model import DomeModel
from services.capture.dome.protocol import ExposureBudget

WATCHDOG_S = 60.0
"""So long that the thread that feeds it, whose clock is the true one, does not take part."""


@dataclass
class Clock:
    """Time in s that passes only by ``advance``."""

    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s

    def advance(self, seconds: float) -> None:
        self.now_s += seconds


@dataclass
class Controller:
    """A controller without a network.

    Attributes:
        lights: number of lights.
        clock: the clock that a transaction moves on.
        delay_s: returns how long the next half of a transaction takes, in s.
        loses: returns whether the next order of light loses its answer.
        flashes_s: times at which light went on, or another light came on.
    """

    lights: int
    clock: Clock
    delay_s: Callable[[], float] = lambda: 0.0
    loses: Callable[[], bool] = lambda: False
    flashes_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.model, self.lock = DomeModel(self.lights, WATCHDOG_S), threading.RLock()

    def look(self) -> None:
        """Let the model see the time."""
        self.model.advance(self.clock())

    def link(self, *_: object) -> ModelLink:
        """A connection to this controller."""
        return ModelLink(self)


class ModelLink:
    """Takes the place of ``ModbusLink``."""

    address = "model"

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    def read(self, register: reg.Register, count: int | None = None, *, repeated: bool = True) -> list[int]:
        del repeated
        with self._controller.lock:
            self._pass()
            values = self._controller.model.values(register)[: register.count if count is None else count]
            if register.space == "discrete":  # three neighbours that the driver reads at once
                row = (reg.INTERLOCK_CLOSED, reg.EMERGENCY_STOP, reg.SUPPLY_ON)
                values = [self._controller.model.values(one)[0] for one in row][:count]
            return values

    def write(self, register: reg.Register, values: list[int]) -> None:
        with self._controller.lock:
            self._pass()
            model = self._controller.model
            before = model.outputs()
            if model.write(register.space, register.address, values):
                raise RefusedError("refused")
            after = model.outputs()
            lit = any(after) and (register is reg.STROBE_MS or after != before)
            if lit:
                self._controller.flashes_s.append(self._controller.clock())
            if lit and self._controller.loses():
                raise NoReplyError("lost")
            self._controller.clock.advance(self._controller.delay_s())

    def close(self) -> None:
        pass

    def _pass(self) -> None:
        self._controller.clock.advance(self._controller.delay_s())
        self._controller.look()


class ModelDome(ModbusDome):
    """The real driver, which waits on the controller's clock."""

    def __init__(self, controller: Controller, flashes: Flashes | None = None) -> None:
        super().__init__("model", 1, ExposureBudget(np.inf, np.inf), WATCHDOG_S, flashes)
        self._link = controller.link()  # type: ignore[assignment]
        self._keepalive._link = controller.link()  # type: ignore[assignment]
        self._clock = controller.clock

    def pause(self, seconds: float) -> None:
        self._clock.advance(seconds)
        super().pause(0.0)


class DarkCameras:
    """Cameras that see what a black frame shows, and as much light as a frame needs."""

    bits, black_level, radiance_per_count = 12, 64, (1.0,)

    def arm(self, exposure_s: float, index: int) -> None:
        del exposure_s
        self._level = 64 if index == 0 else 400

    def read(self) -> tuple[NDArray[np.uint16], ...]:
        return (np.full((2, 2, 1), self._level, dtype=np.uint16),)


def most_in_a_second(times_s: Sequence[float]) -> int:
    """The largest number of times within any second, its end left out."""
    times = np.asarray(sorted(times_s))
    return int((np.searchsorted(times, times + 1.0, side="left") - np.arange(len(times))).max(initial=0))


def random_delays(source: random.Random, most_s: float) -> Callable[[], float]:
    """Delays of a network that varies."""
    return lambda: source.uniform(0.0, most_s)
