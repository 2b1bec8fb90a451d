"""Use cases of the dome by hand: its state, ALL OFF, one light, preflight.

A process of its own drives the dome; see ``process``.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import sqlalchemy as sql
from pydantic import Field

from services.api.dome.process import DomeProcess
from services.api.jobs.jobs import Jobs
from services.api.jobs.light_limits import LightLimits, require_recent
from services.api.jobs.records import Job
from services.client.errors import UnknownDomeError
from services.core.dome import DomeAnswer, DomeStatus
from services.core.errors import DentineError, DomeBusyError, RigUnreachableError, SettingsError
from services.core.geometry import Record
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.records import RigSpec
from services.core.settings import DomeSettings
from services.core.values import Number, Unit, Whole

ANSWER_S = 30.0
"""Longest time in s that a command takes, unless it is a preflight or the first attempt of ALL OFF."""
PREFLIGHT_S = 300.0
"""Longest time in s that a preflight takes."""
OFF_S = 5.0
"""Time in s after which a process that has not switched off is ended, and another one switches off."""
BUSY_S = 2.0
"""Time in s that a command by hand waits for another one to end before it is refused; a light may wait for a second
until it may go on."""
LONGEST_LIGHT_S = 30.0
"""Longest time in s that a light can be switched on for by one request."""


class LightRequest(Record):
    """One light to switch on, all others off."""

    light: Whole = Field(ge=0, lt=2**15, description="index of the light, from 0")
    level: Unit = Field(default=0.05, description="LED level, fraction of full scale")
    on_s: Number = Field(
        default=10.0,
        gt=0,
        le=LONGEST_LIGHT_S,
        description="it goes dark by itself after this time; ask again to keep it on",
    )


class DomeState(Record):
    """The dome and who has it."""

    address: str
    status: DomeStatus
    capturing: tuple[str, ...] = Field(description="jobs whose capture is under way, of those that the caller may see")
    others_capturing: int = Field(description="how many jobs of others capture as well")


class AllOff(Record):
    """What ALL OFF did."""

    status: DomeStatus = Field(description="of the dome, confirmed dark")
    stopped: tuple[str, ...] = Field(
        description="jobs that captured, or waited for it, and were cancelled, of those that the caller may see"
    )
    others_stopped: int = Field(description="how many jobs of others were cancelled as well")


class PreflightResult(Record):
    """What a preflight found. A light or a camera that fails is a problem document instead."""

    findings: tuple[str, ...] = Field(description="what the operator may want to correct; empty when all is well")


class Dome:
    """Use cases of the server's dome, between ``start`` and ``close``."""

    def __init__(self, settings: DomeSettings, jobs: Jobs) -> None:
        self._settings, self._limits = settings, LightLimits(settings)
        self._address, self._jobs, self._process = settings.address, jobs, DomeProcess(settings)
        self._manual_lock = threading.Lock()

    def start(self) -> None:
        """Start the process that drives the dome, so that the first ALL OFF need not wait for it."""
        if self._address is not None:
            try:
                self._process.start()
            except DentineError as problem:
                logging.getLogger(__name__).warning("%s", problem)

    def close(self) -> None:
        """End the process, which leaves the dome dark."""
        self._process.close()

    def state(self, viewer: Viewer = LOCAL_VIEWER) -> DomeState:
        """Read the state from the controller. This disturbs no capture, and no other command waits for it.

        Raises:
            UnknownDomeError: this server has no dome. RigError: the dome does not answer.
        """
        status = _status(self._ask(ANSWER_S, do="status"))
        shown, others = _shown(self._jobs.capturing(), viewer)
        return DomeState(address=self._address or "", status=status, capturing=shown, others_capturing=others)

    def all_off(self, viewer: Viewer = LOCAL_VIEWER) -> AllOff:
        """Switch every light off and stop every capture, without waiting for whatever is using the dome.

        The dome refuses light from then on. Captures are cancelled as well, queued ones too, because the next one that
        begins would arm the dome again. Then the dome is switched off once more, in case a capture has armed it
        meanwhile.

        Raises:
            UnknownDomeError: this server has no dome. RigError: darkness could not be confirmed.
        """
        with ThreadPoolExecutor(1, "stop captures") as stopping:
            # Do both at the same time: captures may have other domes, and a dome or a database that hangs must not keep
            # the other one from being asked.
            stopped = stopping.submit(self._stop_captures)
            with suppress(DentineError):
                self._switch_off()
        status = self._switch_off()
        shown, others = _shown(stopped.result(), viewer)
        return AllOff(status=status, stopped=shown, others_stopped=others)

    def light(self, request: LightRequest, viewer: Viewer = LOCAL_VIEWER) -> DomeStatus:
        """Switch one light on for a limited time.

        Raises:
            UnknownDomeError: this server has no dome. DomeBusyError: a capture or a preflight uses a dome.
                SettingsError: the level is above the limit, or there is no such light. RigError and its kinds.
        """
        if request.level > self._settings.max_level:
            raise SettingsError(
                f"'level': {request.level:g} is above this server's {self._settings.max_level:g}"
                " (DENTINE__SERVER__DOME__MAX_LEVEL); lower it."
            )
        with self._manual_control(viewer):
            return _status(self._ask(ANSWER_S, do="light", **request.model_dump()))

    def dark(self) -> DomeStatus:
        """Switch off the light that was switched on by hand; a capture is not affected.

        Raises:
            UnknownDomeError: this server has no dome. DomeBusyError: a preflight uses it. RigError and its kinds.
        """
        return _status(self._ask(ANSWER_S, do="dark"))

    def preflight(self, rig: RigSpec, viewer: Viewer = LOCAL_VIEWER) -> PreflightResult:
        """Light every light for a moment and look through the cameras.

        Raises:
            UnknownDomeError: this server has no dome. DomeBusyError: a capture or another preflight uses a dome.
                SettingsError, CaptureInputError: the rig is refused. RigError and its kinds.
        """
        if "dome" in rig.model_fields_set and rig.dome != self._address:
            raise SettingsError(f"'dome': this server works the dome at {self._address} and no other; leave it out.")
        if self._address is not None:
            at_address = rig.model_copy(update={"dome": self._address})
            self._limits.require(at_address)
            require_recent(at_address)
        self._jobs.server_paths.require("mouth", rig.mouth)
        with self._manual_control(viewer):
            return PreflightResult(findings=self._ask(PREFLIGHT_S, do="preflight", rig=rig).findings)

    def yield_to_capture(self) -> None:
        """Switch off a light that was switched on by hand, before a capture begins; a preflight is waited for."""
        with self._manual_lock:
            if self._process.is_running:
                with suppress(DentineError):
                    self._ask(ANSWER_S, do="dark")

    @contextmanager
    def _manual_control(self, viewer: Viewer) -> Iterator[None]:
        # Hold the lock while looking for running captures: a capture that begins afterwards waits for it in
        # ``yield_to_capture``.
        if not self._manual_lock.acquire(timeout=BUSY_S):
            raise DomeBusyError("The dome is busy with a preflight; wait for it, or press ALL OFF.")
        try:
            if capturing := self._jobs.capturing():
                shown, _ = _shown(capturing, viewer)
                raise DomeBusyError(
                    f"Job {shown[0]} captures with a dome; wait for it, cancel it, or press ALL OFF."
                    if shown
                    else "A job of others captures with a dome; wait for it, or press ALL OFF."
                )
            yield
        finally:
            self._manual_lock.release()

    def _switch_off(self) -> DomeStatus:
        try:
            return _status(self._process_ask(OFF_S, do="off"))
        except TimeoutError:
            self._process.kill()
        return _status(self._ask(ANSWER_S, do="off"))

    def _stop_captures(self) -> Sequence[Job]:
        try:
            return self._jobs.cancel_captures()
        except sql.exc.SQLAlchemyError:
            logging.getLogger(__name__).exception("captures could not be told of ALL OFF; the dome refuses them light")
            return ()

    def _ask(self, timeout_s: float, **command: object) -> DomeAnswer:
        try:
            return self._process_ask(timeout_s, **command)
        except TimeoutError:
            raise RigUnreachableError(
                f"The dome at {self._address} did not do it within {timeout_s:g} s; press ALL OFF, or its emergency"
                " stop."
            ) from None

    def _process_ask(self, timeout_s: float, **command: object) -> DomeAnswer:
        if self._address is None:
            raise UnknownDomeError(
                "This server has no dome to work by hand; set DENTINE__SERVER__DOME__ADDRESS to its controller's"
                " host:port."
            )
        return self._process.ask(timeout_s, **command)


def _shown(jobs: Sequence[Job], viewer: Viewer) -> tuple[tuple[str, ...], int]:
    """Return the ids of those jobs that a viewer may see, and the number of the others."""
    shown = tuple(job.id for job in jobs if viewer.may_see(job.owner))
    return shown, len(jobs) - len(shown)


def _status(answer: DomeAnswer) -> DomeStatus:
    assert answer.status is not None
    return answer.status
