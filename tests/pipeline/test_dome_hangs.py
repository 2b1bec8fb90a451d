"""A dome's process that no longer reads its commands prevents neither ALL OFF nor the end of the server."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from services.api.dome.dome import Dome, LightRequest
from services.api.jobs.jobs import Jobs
from services.capture.dome.controller import DomeObserver
from services.capture.dome.simulator import simulated_dome
from services.core.errors import RigUnreachableError
from services.core.settings import DomeSettings, ServerSettings

WATCHDOG_S = 10.0
COMMANDS = 2000
"""Number of commands, more than a pipe of 64 KiB holds."""
LONGEST_S = 20.0


@dataclass(frozen=True)
class Hanging:
    """A dome with a light on, its observer, and its process, which is suspended with a full pipe."""

    dome: Dome
    observer: DomeObserver
    process: psutil.Process


@pytest.fixture
def hanging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hanging]:
    with simulated_dome(6, WATCHDOG_S) as (host, port), closing(DomeObserver(host, port)) as observer:
        settings = ServerSettings(data=tmp_path, dome=DomeSettings(address=f"{host}:{port}", watchdog_s=WATCHDOG_S))
        jobs = Jobs(settings, lambda *_: None)
        dome = Dome(settings.dome, jobs)
        dome.light(LightRequest(light=3, on_s=30.0))
        process = next(child for child in psutil.Process().children() if "services.capture.console" in child.cmdline())
        process.suspend()
        try:
            with monkeypatch.context() as hurried:
                hurried.setattr("services.api.dome.dome.ANSWER_S", 0.0)
                require_end(lambda: fill(dome))
            assert observer.status().lit == (3,)
            yield Hanging(dome, observer, process)
        finally:
            with suppress(psutil.NoSuchProcess):
                process.kill()
            dome.close()
            jobs.repository.close()


def ask(dome: Dome) -> None:
    with suppress(RigUnreachableError):
        dome.state()


def fill(dome: Dome) -> None:
    for _ in range(COMMANDS):
        ask(dome)


def require_end(work: Callable[[], object]) -> None:
    """Run a function in a thread, so that the test fails if it never returns."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(LONGEST_S)
    assert not thread.is_alive(), f"it was not done within {LONGEST_S:g} s"


def test_all_off_gets_past_a_process_that_no_longer_reads(hanging: Hanging, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.api.dome.dome.OFF_S", 0.2)
    require_end(hanging.dome.all_off)
    assert hanging.observer.status().lit == ()
    assert hanging.observer.status().stopped
    assert not hanging.process.is_running()


def test_the_server_ends_with_a_process_that_no_longer_reads(hanging: Hanging, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.api.dome.process.EXIT_TIMEOUT_S", 0.2)
    require_end(hanging.dome.close)
    assert not hanging.process.is_running()
