"""A server with a dome, the dome's console without its process, and the lights that are lit."""

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
    """Stand-in for a job's stages that runs the function a test sets; by default it does nothing."""

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
def console(address: Address, **limits: Any) -> Iterator[Callable[..., DomeAnswer]]:
    """Give the console of the dome's process, run inside the test instead of in a process of its own."""
    console = Console(*address, DomeSettings(watchdog_s=WATCHDOG_S, **limits))
    try:
        yield lambda **command: console.answer(DomeCommand(**{"number": 1} | command))
    finally:
        console.close()


def capture(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Run the real capture stage in the caller's process, without a worker."""
    with events.open() as log:
        attempt = log.begin_stage("capture")
        stage.run(spec, LocalContext(folder, attempt, lambda event: log.append(attempt, event)))
