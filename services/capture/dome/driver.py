"""Driver of the dome over Modbus TCP. Safety comes first, because there is a face in the dome.

* A light is on only between ``light`` and ``dark``; every exception, signal, cancel and process end goes through
  ``dark``.
* The controller goes dark by itself when the keep-alive thread stops feeding its watchdog (a killed process), and when
  a light has been on for its strobe time (a process that hangs).
* At most three lights go on in any second, or as many as a person has acknowledged (``flashes``).
* Every commanded light is read back and compared, both the commanded levels and the emitted ones.
* ``interrupt`` darkens the dome during an exposure, from another thread and over the keep-alive's connection; the
  driver switches on no light after it.
* ``all_off`` needs no driver and stops any driver: the controller then refuses light until a driver arms the watchdog
  anew.
* Nothing is written to a device that identifies itself as another one. A device that does not identify itself may be a
  dome with a light on, and is switched off.
"""

from __future__ import annotations

import atexit
import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from services.capture.dome import registers as reg
from services.capture.dome.controller import (
    DARK_ATTEMPTS,
    REPLY_TIMEOUT_S,
    OtherDeviceError,
    error_kind,
    fault_names,
    read_status,
    require_dome,
)
from services.capture.dome.flashes import Flashes
from services.capture.dome.keepalive import KeepAlive
from services.capture.dome.modbus_link import LinkError, ModbusLink, NoReplyError, RefusedError, WrongReplyError
from services.capture.dome.protocol import ExposureBudget, Rgb
from services.core.dome import DomeStatus
from services.core.errors import InterlockError, ReadbackError, RigError, RigStoppedError

HANG_MARGIN_S = 2.0
"""Time in seconds by which the controller's strobe exceeds the planned on-time of a light."""


class ModbusDome:
    """A ``Dome`` behind a Modbus TCP controller. Use it as a context manager; the module lists its guarantees."""

    def __init__(
        self, host: str, port: int, budget: ExposureBudget, watchdog_s: float = 2.0, flashes: Flashes | None = None
    ) -> None:
        self.address = f"{host}:{port}"
        self.watchdog_s = watchdog_s
        self._budget = budget
        self._flashes = flashes or Flashes()
        self._link = ModbusLink(host, port, REPLY_TIMEOUT_S)
        self._keepalive = KeepAlive(ModbusLink(host, port, REPLY_TIMEOUT_S), watchdog_s)
        self._light_count = 0
        self._lit: tuple[range, float, float] | None = None
        self._previous_handlers: dict[int, object] = {}
        self._interrupted = threading.Event()
        self._interruption: Exception | None = None

    def __enter__(self) -> Self:
        try:
            self._require_dome()
            with self._dark_on_error():
                self._identify()
                self._require_safe()
                self._write_checked(reg.WATCHDOG_MS, [round(1000 * self.watchdog_s)])
                self._link.write(reg.FAULT_RESET, [1])
                self._keepalive.start()
                self._require_no_fault()
                self.dark()
                self._flashes.begin()
        except BaseException:
            self._keepalive.stop()
            self._link.close()
            raise
        atexit.register(self._darken_at_exit)
        self._catch_signals()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            # Start from a new connection, because an exception may have come between a request and its answer.
            if kind is not None:
                self._link.close()
            self.dark()
            if self._interruption is not None and isinstance(problem, RigError):
                raise self._interruption from problem
        except RigError:
            # Report that a light may still be on rather than a cancel; if another rig error is on its way, that one has
            # reported it already.
            if not isinstance(problem, RigError):
                raise
        finally:
            self._keepalive.stop()
            self._link.close()
            atexit.unregister(self._darken_at_exit)
            self._release_signals()

    @property
    def light_count(self) -> int:
        """Number of lights fitted."""
        return self._light_count

    @property
    def flash_interval_s(self) -> float:
        """Shortest time in s between two lights."""
        return self._flashes.interval_s

    def light(self, index: int | None, level: float, on_s: float) -> Rgb:
        """Switch one light on, or all for None; see ``Dome.light``."""
        lights = range(self._light_count) if index is None else range(index, index + 1)
        with self._dark_on_error():
            was_lit = self._lit is not None
            self._record_dose()
            self._require_uninterrupted()
            if not lights or lights.stop > self._light_count or lights.start < 0:
                raise RigError(
                    f"Light {index} does not exist, the dome at {self.address} has {self._light_count}; correct the"
                    " plan."
                )
            self._budget.require(lights, level, on_s)
            self._await_flash(was_lit=was_lit)
            self._require_safe()
            self._keepalive.require_alive()
            strobe_ms = min(math.ceil(1000 * (on_s + HANG_MARGIN_S)), reg.FULL_SCALE)
            active = reg.ALL_LIGHTS if index is None else index
            self._lit = (lights, level, time.monotonic())
            # Feed the watchdog here too, so that a light does not depend on when the thread last ran.
            with suppress(NoReplyError, WrongReplyError):
                self._link.write(reg.KEEPALIVE, [1])
            # Send the order once. If its answer is lost or wrong, the read-back decides whether the light was set.
            try:
                self._link.write(reg.STROBE_MS, [strobe_ms, active, *[reg.level_word(level)] * 3])
            except (NoReplyError, WrongReplyError):
                pass
            finally:
                self._flashes.count()
            self._require_uninterrupted()
            return self._confirmed()

    def confirm(self) -> Rgb:
        """Check that exactly the commanded light is emitting; see ``Dome.confirm``."""
        with self._dark_on_error():
            return self._confirmed()

    def trigger(self) -> None:
        """Pulse the cameras' trigger line and check that the controller counted it."""
        with self._dark_on_error():
            before = self._link.read(reg.TRIGGER_COUNT)[0]
            with suppress(NoReplyError, WrongReplyError):
                self._link.write(reg.EXPOSURE_TRIGGER, [1])
            if self._link.read(reg.TRIGGER_COUNT)[0] != (before + 1) & 0xFFFF:
                raise RigError(
                    f"The dome at {self.address} did not trigger the cameras; check the controller and run again."
                )

    def dark(self) -> None:
        """Switch off every light and check it. Only this order is repeated, because it can only make the dome safer."""
        problem: Exception | None = None
        for _ in range(DARK_ATTEMPTS):
            try:
                self._link.write(reg.ALL_OFF, [1])
                emitting = np.flatnonzero(self._rgb(reg.OUTPUTS).any(axis=1))
            except LinkError as failure:
                self._link.close()
                problem = failure
                continue
            if not len(emitting):
                self._record_dose()
                return
            problem = LinkError(f"light {int(emitting[0])} still emits after all-off")
        # Stop feeding the watchdog as a last resort, which makes the controller open the supply relay.
        self._keepalive.stop()
        self._record_dose()
        raise ReadbackError(
            f"The dome at {self.address} is not confirmed dark ({problem}); its watchdog cuts the supply within"
            f" {self.watchdog_s:g} s, switch the dome off."
        ) from problem

    def pause(self, seconds: float) -> None:
        """Let time pass with the light as it is; see ``Dome.pause``."""
        self._interrupted.wait(seconds)
        with self._dark_on_error():
            self._require_uninterrupted()

    def interrupt(self, reason: Exception) -> None:
        """Go dark at once, from any thread; see ``Dome.interrupt``."""
        # Set the reason before the order, so that a light that the driver sends meanwhile is found unwanted afterwards.
        self._interruption = reason
        self._interrupted.set()
        with suppress(LinkError):
            self._keepalive.darken()
        # Confirm darkness here too, because the driver's own thread may be waiting for a camera. If this fails, the
        # watchdog is no longer fed.
        with suppress(RigError):
            self.dark()

    def give_up(self) -> None:
        """Go dark if possible and stop feeding the watchdog, so that the driver gets no further light; any thread may
        call it.
        """
        try:
            with suppress(RigError):
                self.dark()
        finally:
            self._keepalive.stop()

    def status(self) -> DomeStatus:
        """Read the controller's state."""
        with self._dark_on_error():
            return read_status(self._link)

    @contextmanager
    def _dark_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException as problem:
            is_dark = False
            with suppress(RigError):
                self.dark()
                is_dark = True
            if is_dark and self._interruption is not None and isinstance(problem, (LinkError, RigError)):
                # Report the interruption: a light that is dark because of it is not a fault of the dome.
                raise self._interruption from problem
            if isinstance(problem, LinkError):
                # Report ALL OFF or an open interlock as the cause of a refusal rather than the exception code.
                if isinstance(problem, RefusedError):
                    with suppress(LinkError):
                        self._require_armed()
                        self._require_safe()
                        self._require_no_fault()
                raise error_kind(problem)(
                    f"Dome failure: {problem}; lights were switched off, check the controller and its network."
                ) from problem
            raise

    def _await_flash(self, *, was_lit: bool) -> None:
        """Wait until light may go on. A light that is on goes dark first, as its time is planned without the wait."""
        self._flashes.require_allowed()
        if was_lit and self._flashes.wait_s():
            self.dark()
        while wait_s := self._flashes.wait_s():
            self.pause(wait_s)

    def _confirmed(self) -> Rgb:
        self._require_safe()
        self._require_no_fault()
        lit, commanded = self._lit, np.zeros((self._light_count, 3), dtype=np.int64)
        if lit is not None:
            commanded[lit[0]] = reg.level_word(lit[1])
        for register in (reg.LEVELS, reg.OUTPUTS):
            read_back = self._rgb(register)
            wrong = np.flatnonzero((read_back != commanded).any(axis=1))
            if len(wrong):
                self._require_armed()
                light = int(wrong[0])
                raise ReadbackError(
                    f"Light {light} {'holds' if register is reg.LEVELS else 'emits'} {read_back[light].tolist()}"
                    f" instead of {commanded[light].tolist()}; all lights were switched off, check that light and the"
                    " controller."
                )
        first = lit[0].start if lit else 0
        return int(read_back[first, 0]), int(read_back[first, 1]), int(read_back[first, 2])

    def _require_dome(self) -> None:
        try:
            require_dome(self._link)
        except (OtherDeviceError, RefusedError) as answer:
            raise RigError(
                f"The device at {self.address} does not answer as a dome controller; correct rig.dome."
            ) from answer
        except LinkError:
            with self._dark_on_error():
                raise

    def _identify(self) -> None:
        firmware = self._link.read(reg.FIRMWARE)[0]
        if firmware >> 8 != reg.FIRMWARE_MAJOR:
            raise RigError(
                f"The dome at {self.address} runs firmware {firmware >> 8}, this driver needs {reg.FIRMWARE_MAJOR};"
                " update one of them."
            )
        self._light_count = self._link.read(reg.LIGHT_COUNT)[0]
        if not 1 <= self._light_count <= reg.MAX_LIGHTS:
            raise RigError(
                f"The dome at {self.address} reports {self._light_count} lights, outside 1 to {reg.MAX_LIGHTS}; check"
                " its configuration."
            )

    def _require_safe(self) -> None:
        closed, pressed = self._link.read(reg.INTERLOCK_CLOSED, 2)
        if pressed:
            raise InterlockError(
                f"The emergency stop of the dome at {self.address} is pressed; release it when the subject is safe and"
                " run again."
            )
        if not closed:
            raise InterlockError(f"The interlock of the dome at {self.address} is open; close it and run again.")

    def _require_uninterrupted(self) -> None:
        if self._interruption is not None:
            raise self._interruption

    def _require_armed(self) -> None:
        if self._link.read(reg.WATCHDOG_MS)[0] == reg.STOPPED_MS:
            raise RigStoppedError(
                f"ALL OFF was pressed for the dome at {self.address} and it stays dark; start again when the subject is"
                " ready."
            )

    def _require_no_fault(self) -> None:
        faults = reg.FaultBit(self._link.read(reg.FAULTS)[0])
        if faults:
            self._require_armed()
            raise RigError(
                f"The dome at {self.address} reports {' and '.join(fault_names(faults))}; remove the cause and run"
                " again."
            )

    def _rgb(self, register: reg.Register) -> NDArray[np.int64]:
        return np.asarray(self._link.read(register, 3 * self._light_count), dtype=np.int64).reshape(-1, 3)

    def _write_checked(self, register: reg.Register, values: list[int]) -> None:
        with suppress(NoReplyError, WrongReplyError):
            self._link.write(register, values)
        read_back = self._link.read(register)
        if read_back != values:
            raise ReadbackError(
                f"The dome at {self.address} holds {register.name} = {read_back} instead of {values}; restart the"
                " controller."
            )

    def _record_dose(self) -> None:
        lit, self._lit = self._lit, None
        if lit is not None:
            lights, level, since_s = lit
            self._budget.spend(lights, level, time.monotonic() - since_s)

    def _darken_at_exit(self) -> None:
        self._link.close()
        self.give_up()

    def _catch_signals(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(number) is signal.SIG_DFL:
                    self._previous_handlers[number] = signal.signal(number, _exit_on_signal)

    def _release_signals(self) -> None:
        for number in self._previous_handlers:
            signal.signal(number, signal.SIG_DFL)
        self._previous_handlers.clear()


def _exit_on_signal(number: int, _frame: FrameType | None) -> None:
    """Turn a terminating signal into an exception, so that every context manager on the stack runs."""
    raise SystemExit(128 + number)
