"""What can be done with the dome by hand: look, ALL OFF, one light, preflight.

What drives it is a process of its own; see ``process``.
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
from services.api.jobs.light_limits import LightLimits
from services.api.jobs.records import Job
from services.client.errors import UnknownDomeError
from services.core.dome import DomeAnswer, DomeStatus
from services.core.errors import DentineError, DomeBusyError, RigUnreachableError, SettingsError
from services.core.geometry import Record
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.records import Number, RigSpec, Unit, Whole
from services.core.settings import DomeSettings

ANSWER_S = 30.0
PREFLIGHT_S = 300.0
OFF_S = 5.0
"""A process that has not switched off by then is ended, and another one does it."""
BUSY_S = 1.0
LONGEST_LIGHT_S = 30.0


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
    """Use-cases over the server's dome; ``start`` and ``close`` frame the time in which it is worked."""

    def __init__(self, settings: DomeSettings, jobs: Jobs) -> None:
        self._settings, self._limits = settings, LightLimits(settings)
        self._address, self._jobs, self._process = settings.address, jobs, DomeProcess(settings)
        self._driving = threading.Lock()

    def start(self) -> None:
        """Start the process, so that the first ALL OFF need not wait for it."""
        if self._address is not None:
            try:
                self._process.start()
            except DentineError as problem:
                logging.getLogger(__name__).warning("%s", problem)

    def close(self) -> None:
        """Leave the dome dark."""
        self._process.close()

    def state(self, viewer: Viewer = LOCAL_VIEWER) -> DomeState:
        """What the controller says; nothing waits for it and it disturbs no capture.

        Raises:
            UnknownDomeError: this server has none. RigError: it does not answer.
        """
        status = _status(self._ask(ANSWER_S, do="status"))
        shown, others = _shown(self._jobs.capturing(), viewer)
        return DomeState(address=self._address or "", status=status, capturing=shown, others_capturing=others)

    def all_off(self, viewer: Viewer = LOCAL_VIEWER) -> AllOff:
        """Switch every light off and stop every capture; waits for nobody who has the dome.

        The dome refuses light from then on. Captures are cancelled as well, queued ones too, as whichever begins next
        would arm the dome anew; then the dome is stopped again, for one that has done so meanwhile.

        Raises:
            UnknownDomeError: this server has none. RigError: darkness could not be confirmed.
        """
        with ThreadPoolExecutor(1, "stop captures") as stopping:
            # Beside each other: captures may have other domes, and neither a dome nor a database that hangs keeps the
            # other from being told.
            stopped = stopping.submit(self._stop_captures)
            with suppress(DentineError):
                self._switch_off()
        status = self._switch_off()
        shown, others = _shown(stopped.result(), viewer)
        return AllOff(status=status, stopped=shown, others_stopped=others)

    def light(self, wanted: LightRequest, viewer: Viewer = LOCAL_VIEWER) -> DomeStatus:
        """Switch one light on for a while.

        Raises:
            UnknownDomeError: this server has none. DomeBusyError: a capture or a preflight has it. SettingsError: no
                such light. RigError and its kinds.
        """
        if wanted.level > self._settings.max_level:
            raise SettingsError(
                f"'level': {wanted.level:g} is above this server's {self._settings.max_level:g}"
                " (DENTINE__SERVER__DOME__MAX_LEVEL); lower it."
            )
        with self._driven_by_hand(viewer):
            return _status(self._ask(ANSWER_S, do="light", **wanted.model_dump()))

    def dark(self) -> DomeStatus:
        """Switch the light off that was switched on by hand; a capture is left alone.

        Raises:
            UnknownDomeError: this server has none. DomeBusyError: a preflight has it. RigError and its kinds.
        """
        return _status(self._ask(ANSWER_S, do="dark"))

    def preflight(self, rig: RigSpec, viewer: Viewer = LOCAL_VIEWER) -> PreflightResult:
        """Light every light for a moment and look through the cameras.

        Raises:
            UnknownDomeError: this server has none. DomeBusyError: a capture has it. SettingsError, CaptureInputError:
                the rig. RigError and its kinds.
        """
        if "dome" in rig.model_fields_set and rig.dome != self._address:
            raise SettingsError(f"'dome': this server works the dome at {self._address} and no other; leave it out.")
        if self._address is not None:
            self._limits.require(rig.model_copy(update={"dome": self._address}))
        self._jobs.server_paths.require("mouth", rig.mouth)
        with self._driven_by_hand(viewer):
            return PreflightResult(findings=self._ask(PREFLIGHT_S, do="preflight", rig=rig).findings)

    def make_way(self) -> None:
        """End a light by hand before a capture begins; a preflight is awaited."""
        with self._driving:
            if self._process.is_running:
                with suppress(DentineError):
                    self._ask(ANSWER_S, do="dark")

    @contextmanager
    def _driven_by_hand(self, viewer: Viewer) -> Iterator[None]:
        # Held while the question is asked whether a capture runs: one that begins afterwards makes its way after us.
        if not self._driving.acquire(timeout=BUSY_S):
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
            self._driving.release()

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
    """Ids of those jobs that somebody may see, and how many others there are."""
    shown = tuple(job.id for job in jobs if viewer.may_see(job.owner))
    return shown, len(jobs) - len(shown)


def _status(answer: DomeAnswer) -> DomeStatus:
    assert answer.status is not None
    return answer.status
