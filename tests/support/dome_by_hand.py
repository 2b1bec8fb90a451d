"""A server with a dome, and what the dome emits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from services.capture import stage
from services.capture.console import Console
from services.capture.dome.controller import DomeObserver
from services.core.dome import DomeAnswer, DomeCommand
from services.core.records import JobSpec
from services.core.settings import DomeSettings, ServerSettings
from services.core.stage import LocalContext
from services.pipeline.event_log import EventAddress
from tests.support.mouth import write_mouth

LIGHTS = 6
WATCHDOG_S = 10.0
Address = tuple[str, int]


def settings_of(address: Address, data: Path, **more: Any) -> ServerSettings:
    dome = DomeSettings(address=f"{address[0]}:{address[1]}", watchdog_s=WATCHDOG_S, **more)
    return ServerSettings(data=data, dome=dome)


class Jobs:
    """In place of a job's stages: what a test says, nothing by default."""

    def __init__(self) -> None:
        self.run: Callable[[JobSpec, Path, EventAddress], object] = nothing

    def __call__(self, spec: JobSpec, folder: Path, events: EventAddress) -> None:
        self.run(spec, folder, events)


def nothing(*_: object) -> None:
    pass


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s, "waited for a minute in vain"
        time.sleep(0.01)


def lit(observer: DomeObserver) -> tuple[int, ...]:
    return observer.status().lit


def problem_of(answer: httpx.Response) -> tuple[int, str]:
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    return answer.status_code, answer.json()["code"]


def rig(tmp_path: Path, **options: Any) -> dict[str, Any]:
    if not (tmp_path / "mouth").exists():
        write_mouth(tmp_path / "mouth", LIGHTS)
    return {
        "mouth": str(tmp_path / "mouth"),
        "exposure_s": 0.01,
        "settle_s": 0.0,
        "watchdog_s": WATCHDOG_S,
        "tracking_every": 3,
        **options,
    }


@contextmanager
def console(address: Address, **limits: float) -> Iterator[Callable[..., DomeAnswer]]:
    """The dome's process without a process around it."""
    console = Console(*address, DomeSettings(watchdog_s=WATCHDOG_S, **limits))
    try:
        yield lambda **command: console.answer(DomeCommand(**{"number": 1} | command))
    finally:
        console.close()


def capture(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """The real capture, without a worker around it."""
    with events.open() as log:
        attempt = log.begin_stage("capture")
        stage.run(spec, LocalContext(folder, attempt, lambda event: log.append(attempt, event)))
