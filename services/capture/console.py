"""Manual control of the dome: a process that a server starts and that receives commands over its pipes.

::

    python -m services.capture.console '{"address": "host:port", ...}'    DomeCommand lines in, DomeAnswer lines out

Commands run concurrently, so that ALL OFF and the status wait for no other command; only one command at a time drives
the dome. The process ends when its standard input closes, so also when its parent is killed, and leaves the dome dark.
A light that is on goes dark when its time is over, by this process and also by the controller's strobe. If this process
is killed, the light goes dark within the watchdog period.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial

from services.capture.dome.address import dome_address
from services.capture.dome.all_off import all_off
from services.capture.dome.controller import DomeObserver
from services.capture.dome.driver import ModbusDome
from services.capture.dome.flashes import Flashes
from services.capture.dome.protocol import ExposureBudget
from services.core.dome import DomeAnswer, DomeCommand, DomeStatus
from services.core.errors import DentineError, DomeBusyError, RigError, RigStoppedError, SettingsError
from services.core.records import LOWERED_LIMITS, SIMULATED_DOME
from services.core.settings import DomeSettings

CHECK_INTERVAL_S = 0.1
"""Interval at which a light that is on is checked, seconds."""
LOCK_TIMEOUT_S = 2.0
"""Time that a command waits for another one that drives the dome, seconds; a light waits for a second before it."""
DOSE_WINDOW_S = 1e4
"""Time over which doses of light add up (IEC 62471), seconds. A limit holds for all manual light since the dome was
last dark for this long."""
SIMULATED_LIGHTS = 155
"""Number of lights of a simulated dome."""


class Console:
    """Driver of one dome by commands; ``close`` leaves the dome dark."""

    def __init__(self, host: str, port: int, settings: DomeSettings) -> None:
        self._host, self._port, self._settings = host, port, settings
        self._is_simulated = settings.address == SIMULATED_DOME
        self._driver_lock, self._closing = threading.Lock(), threading.Event()
        self._resources = ExitStack()
        self._dome: ModbusDome | None = None
        self._budget, self._until_s = (
            ExposureBudget(settings.light_exposure_limit_s, settings.total_exposure_limit_s),
            0.0,
        )
        self._newest_off, self._order_lock = 0, threading.Lock()
        self._light_watch = threading.Thread(target=self._watch_light, name="light watch")
        self._light_watch.start()

    def answer(self, command: DomeCommand) -> DomeAnswer:
        """Carry out a command; errors become part of the answer."""
        try:
            return self._carry_out(command)
        except DentineError as problem:
            return DomeAnswer(number=command.number, code=problem.code, message=problem.message)
        except Exception as problem:
            return DomeAnswer(
                number=command.number,
                code=DentineError.code,
                message=f"The dome's console broke with {type(problem).__name__}: {problem}.",
            )

    def close(self) -> None:
        """Make the dome dark and end, also in the middle of a preflight."""
        self._closing.set()
        if not self._driver_lock.acquire(timeout=LOCK_TIMEOUT_S):
            with suppress(RigError):
                self._all_off()
            self._driver_lock.acquire()
        with suppress(RigError):
            self._disconnect()
        self._driver_lock.release()
        self._light_watch.join()

    def _carry_out(self, command: DomeCommand) -> DomeAnswer:
        findings: tuple[str, ...] = ()
        if command.do == "off":
            with self._order_lock:
                self._newest_off = max(self._newest_off, command.number)
            try:
                status = self._all_off()
            finally:
                if self._driver_lock.acquire(timeout=LOCK_TIMEOUT_S):
                    self._disconnect_and_release()
            return DomeAnswer(number=command.number, status=status)
        if command.do != "status":
            if not self._driver_lock.acquire(timeout=LOCK_TIMEOUT_S):
                raise DomeBusyError("The dome is busy with a preflight; wait for it, or press ALL OFF.")
            try:
                self._require_current(command)
                if command.do == "light":
                    self._light(command)
                else:
                    self._disconnect()
                if command.do == "preflight":
                    findings = self._preflight(command)
            finally:
                self._driver_lock.release()
        return DomeAnswer(number=command.number, status=self._status(), findings=findings)

    def _all_off(self) -> DomeStatus:
        try:
            return all_off(self._host, self._port)
        except BaseException:
            # Use the driver's own connection, because the controller may accept no further one.
            if (dome := self._dome) is not None:
                dome.give_up()
            raise

    def _disconnect_and_release(self) -> None:
        try:
            with suppress(RigError):
                self._disconnect()
        finally:
            self._driver_lock.release()

    def _light(self, command: DomeCommand) -> None:
        try:
            if self._dome is None:
                self._forget_old_dose()
                self._dome = self._resources.enter_context(
                    ModbusDome(self._host, self._port, self._budget, self._settings.watchdog_s, self._flashes())
                )
            self._require_current(command)
            _require_light(command.light, self._dome.light_count)
            self._dome.light(command.light, command.level, command.on_s)
        except BaseException:
            with suppress(RigError):
                self._disconnect()
            raise
        self._until_s = time.monotonic() + command.on_s

    def _preflight(self, command: DomeCommand) -> tuple[str, ...]:
        from services.capture.preflight import preflight
        from services.capture.rig import PlannedRig

        if command.rig is None:
            raise SettingsError("A preflight needs a rig; give its mouth folder.")
        limits = {name: min(getattr(command.rig, name), getattr(self._settings, name)) for name in LOWERED_LIMITS}
        limits["assessment"] = command.rig.assessment or self._settings.assessment
        planned = PlannedRig.read(command.rig.model_copy(update={"dome": f"{self._host}:{self._port}", **limits}))
        self._forget_old_dose()
        try:
            with planned.in_use(self._budget.spent_s, is_simulated=self._is_simulated) as (self._dome, cameras):
                return preflight(
                    planned.plan, self._dome, cameras, planned.spec, partial(self._require_current, command)
                )
        finally:
            self._dome, self._until_s = None, time.monotonic()

    def _flashes(self) -> Flashes:
        return Flashes.of_no_real_light() if self._is_simulated else Flashes()

    def _forget_old_dose(self) -> None:
        if time.monotonic() > self._until_s + DOSE_WINDOW_S:
            self._budget.spent_s.clear()

    def _require_current(self, command: DomeCommand) -> None:
        # Checked before the watchdog is armed, because arming would undo ALL OFF, and again afterwards. After an ALL
        # OFF that comes later, the controller itself refuses light.
        with self._order_lock:
            is_outdated = command.number < self._newest_off
        if is_outdated:
            raise RigStoppedError("ALL OFF was pressed after this was asked for; ask again when the subject is ready.")

    def _status(self) -> DomeStatus:
        observer = DomeObserver(self._host, self._port)
        try:
            return observer.status()
        finally:
            observer.close()

    def _watch_light(self) -> None:
        # Darkens a light whose time is over, or that differs from the commanded one.
        while not self._closing.wait(CHECK_INTERVAL_S):
            with self._driver_lock:
                if self._dome is None:
                    continue
                try:
                    self._dome.confirm()
                    if time.monotonic() > self._until_s:
                        self._disconnect()
                except RigError as problem:
                    print(problem.message, file=sys.stderr)
                    with suppress(RigError):
                        self._disconnect()

    def _disconnect(self) -> None:
        resources, self._resources, self._dome = self._resources, ExitStack(), None
        resources.close()


def _require_light(light: int, count: int) -> None:
    if not 0 <= light < count:
        raise SettingsError(f"Light {light} does not exist, the dome has lights 0 to {count - 1}; choose one of them.")


def _main() -> None:
    settings = DomeSettings.model_validate(json.loads(sys.argv[1]))
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    output_lock = threading.Lock()
    with ExitStack() as stack:
        host, port = stack.enter_context(dome_address(settings.address or "", SIMULATED_LIGHTS, settings.watchdog_s))
        console = Console(host, port, settings)
        stack.callback(console.close)

        def execute(line: str) -> None:
            answer = console.answer(DomeCommand.model_validate_json(line)).model_dump_json()
            with output_lock, suppress(BrokenPipeError):
                print(answer, flush=True)

        for line in sys.stdin:
            threading.Thread(target=execute, args=(line,), daemon=True).start()


if __name__ == "__main__":
    _main()
