"""Time for which the dome stays lit after a cancel, an ALL OFF or a signal in the middle of an exposure.

python -m tests.benchmarks.dark --json dark.json --times 300
python -m tests.benchmarks.dark --json dark.json --times 300 --under upload half-open

A real capture lights a simulated dome over Modbus, while an observer reads the registers of the emitted light all the
time over a connection of its own. A time runs from just before the request or signal is sent until the answer of the
first reading without light after which no light is seen again. Exposures last 2 s and are interrupted in their first
0.8 s, so a program that waits for an exposure's end takes at least 1.2 s. New times are added to those in the file, so
a killed run loses none. A hundred times of one way take about ten minutes.

==========  =======================================================================================
cancel      POST /v1/jobs/<id>/cancel
all-off     POST /v1/dome/off, for the dome of the server
page        ALL OFF in the dome's page, beside eight pages that follow the job in the same browser
signal      SIGTERM to ``dentine capture``
serve       SIGTERM to ``dentine serve``, with an event stream open
==========  =======================================================================================

Loads on the server, each from a process of its own (``dark_loads``): ``upload`` sends captures all the time,
``half-open`` holds 1,500 connections whose first request never ends its headers. The way ``signal`` has no server.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import httpx

from services.capture.dome.controller import DomeObserver
from services.capture.dome.simulator import simulated_dome
from services.core.store import write_atomic
from tests.benchmarks.dark_loads import LOADS, allow_many_connections, loaded
from tests.browser.chromium import ARGUMENTS
from tests.support.live_server import running_server
from tests.support.mouth import write_mouth

LIGHTS, TABS = 6, 8
EXPOSURE_S = 2.0
STEADY_S = 0.3
"""Time of unbroken light after which it counts as an exposure and not as a flash of the preflight, on all but a very
busy machine."""
STRIKE_WITHIN_S = 0.5
PATIENCE_S = 120.0
QUIET_S = 0.3
"""Time of darkness after which the dome counts as dark for good."""
LOOK_EVERY_S = 0.003
"""Pause between two readings, which keeps the observer's share of the processor small."""


class Observer:
    """Reads the dome's emitted light all the time in a thread of its own."""

    def __init__(self, host: str, port: int) -> None:
        self._dome, self._ending = DomeObserver(host, port), threading.Event()
        self._lit_since_s: float | None = None
        self._dark_since_s = time.monotonic()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._ending.is_set():
            asked_s = time.monotonic()
            is_lit = bool(self._dome.outputs().any())
            if is_lit:
                self._lit_since_s = self._lit_since_s if self._lit_since_s is not None else asked_s
            elif self._lit_since_s is not None:
                self._lit_since_s, self._dark_since_s = None, time.monotonic()
            self._ending.wait(LOOK_EVERY_S)

    def await_exposure(self) -> None:
        """Wait until a light has been on for a while, then for a random time."""
        while True:
            _wait(lambda: (since_s := self._lit_since_s) is not None and time.monotonic() > since_s + STEADY_S)
            time.sleep(random.uniform(0, STRIKE_WITHIN_S))
            if self._lit_since_s is not None:
                return

    def await_dark(self) -> float:
        """Wait until the dome is dark for good; returns the time of the first dark reading."""
        _wait(lambda: self._lit_since_s is None and time.monotonic() > self._dark_since_s + QUIET_S)
        return self._dark_since_s

    def close(self) -> None:
        """Stop reading."""
        self._ending.set()
        self._thread.join()
        self._dome.close()


class Bench:
    """A dome with its observer, and a mouth for the simulated cameras."""

    def __init__(self, folder: Path, host: str, port: int, observer: Observer, loads: tuple[str, ...]) -> None:
        self.folder, self.observer, self._address, self._loads = folder, observer, f"{host}:{port}", loads
        write_mouth(folder / "mouth", LIGHTS)
        self._count = 0

    @property
    def rig(self) -> dict[str, Any]:
        """Description of a rig with exposures of ``EXPOSURE_S``."""
        mouth = str(self.folder / "mouth")
        return {
            "mouth": mouth,
            "dome": self._address,
            "exposure_s": EXPOSURE_S,
            "level": 0.5,
            "black_frames": 1,
            "tracking_every": 0,
        }

    def new_folder(self) -> Path:
        """Path of a folder that was not used before."""
        self._count += 1
        return self.folder / f"run-{self._count}"

    @contextmanager
    def server(self) -> Iterator[tuple[httpx.Client, subprocess.Popen[str]]]:
        """Run ``dentine serve`` with this dome and the loads on it for the time of the block."""
        environment = os.environ | {"DENTINE__SERVER__DOME__ADDRESS": self._address}
        command = [sys.executable, "-m", "services", "serve", "--port", "0", "--data", str(self.new_folder())]
        with (
            (self.folder / "server.log").open("a") as log,
            running_server(command, log, environment=environment) as running,
            ExitStack() as loads,
        ):
            for load in self._loads:
                loads.enter_context(loaded(load, str(running[0].base_url), log))
            yield running

    def submit(self, client: httpx.Client) -> str:
        """Submit a job that captures; returns its id."""
        job: str = client.post("/v1/jobs", json={"rig": self.rig, "workers": 1}).raise_for_status().json()["id"]
        return job

    def strike(self, how: Callable[[], object]) -> float:
        """Call ``how`` in the middle of an exposure; returns the seconds until the dome is dark."""
        self.observer.await_exposure()
        began_s = time.monotonic()
        how()
        return self.observer.await_dark() - began_s


def strike_by_request(bench: Bench, path: str) -> Generator[float]:
    """Post to ``path`` (cancel or ALL OFF) in one capture after the other of one server; yields the seconds."""
    with bench.server() as (client, _):
        while True:
            job = bench.submit(client)
            yield bench.strike(lambda job=job: client.post(path.format(job=job)).raise_for_status())  # type: ignore[misc]
            client.get(f"/v1/jobs/{job}/events")


def strike_by_page(bench: Bench) -> Generator[float]:
    """Press ALL OFF in the dome's page while eight pages of the same browser follow the job that captures."""
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium") or shutil.which("google-chrome")
    with (
        bench.server() as (client, _),
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS)) as browser,
    ):
        context = browser.new_context(base_url=str(client.base_url))
        dome, *tabs = (context.new_page() for _ in range(1 + TABS))
        dome.goto("/#/dome")
        for tab in tabs:
            tab.goto("/#/new")
        while True:
            job = bench.submit(client)
            for tab in tabs:
                tab.evaluate("job => { location.hash = `#/${job}`; }", job)
            yield bench.strike(lambda: dome.evaluate("document.querySelector('.all-off').click()"))
            client.get(f"/v1/jobs/{job}/events")


def strike_capture(bench: Bench) -> Generator[float]:
    """Send SIGTERM to one ``dentine capture`` after the other."""
    job = bench.folder / "JOB.toml"
    job.write_text("[rig]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in bench.rig.items()))
    while True:
        command = [sys.executable, "-m", "services", "capture", str(job), "--out", str(bench.new_folder())]
        with (
            (bench.folder / "capture.log").open("a") as log,
            subprocess.Popen(command, stdout=log, stderr=log) as process,
        ):
            yield bench.strike(partial(process.send_signal, signal.SIGTERM))


def strike_server(bench: Bench) -> Generator[float]:
    """Send SIGTERM to one ``dentine serve`` after the other while a page follows its job."""
    while True:
        with bench.server() as (client, process):
            job = bench.submit(client)
            with client.stream("GET", f"/v1/jobs/{job}/events"):
                taken_s = bench.strike(partial(process.send_signal, signal.SIGTERM))
            process.wait(PATIENCE_S)
        yield taken_s


WAYS: dict[str, Callable[[Bench], Generator[float]]] = {
    "cancel": lambda bench: strike_by_request(bench, "/v1/jobs/{job}/cancel"),
    "all-off": lambda bench: strike_by_request(bench, "/v1/dome/off"),
    "page": strike_by_page,
    "signal": strike_capture,
    "serve": strike_server,
}


def _wait(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise RuntimeError(f"Nothing was lit or dark within {PATIENCE_S:g} s; see the logs.")
        time.sleep(0.002)


def main() -> None:
    """Measure ``--times`` times each way and print the longest and the median time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=300)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--under", nargs="*", choices=LOADS, default=[], help="loads of the server, all at once")
    wanted = parser.parse_args()
    allow_many_connections()
    told: dict[str, Any] = json.loads(wanted.json.read_text()) if wanted.json.exists() else {}
    with tempfile.TemporaryDirectory() as folder, simulated_dome(LIGHTS, 2.0) as (host, port):
        observer = Observer(host, port)
        try:
            for way in wanted.ways:
                name = f"{way} under {' and '.join(wanted.under)}" if wanted.under else way
                seconds: list[float] = told.get(name, {}).get("seconds", [])
                strikes = WAYS[way](Bench(Path(folder) / way, host, port, observer, tuple(wanted.under)))
                while len(seconds) < wanted.times:
                    seconds.append(round(next(strikes), 4))
                    told[name] = {
                        "n": len(seconds),
                        "worst_s": max(seconds),
                        "median_s": statistics.median(seconds),
                        "seconds": seconds,
                    }
                    write_atomic(wanted.json, json.dumps(told, indent=1).encode())
                strikes.close()
                print(
                    f"{name}: worst of {len(seconds)} {max(seconds):.3f} s, median {statistics.median(seconds):.3f} s",
                    flush=True,
                )
        finally:
            observer.close()


if __name__ == "__main__":
    main()
