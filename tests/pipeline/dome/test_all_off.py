"""ALL OFF darkens the dome whatever else is running, and the dome stays dark."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import psutil
import pytest

from services.capture.dome import registers as reg
from services.capture.dome.controller import DomeObserver
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault
from services.core.errors import RigStoppedError
from tests.support.dome_by_hand import WATCHDOG_S, Address, Jobs, capture, console, lit, rig, wait_until


def test_all_off_holds_until_somebody_starts_anew(client: httpx.Client, observer: DomeObserver) -> None:
    client.put("/v1/dome/light", json={"light": 2, "on_s": 30})
    answer = client.post("/v1/dome/off").json()
    assert (answer["status"]["lit"], answer["status"]["stopped"], answer["stopped"]) == ([], True, [])
    assert lit(observer) == ()
    assert client.get("/v1/dome").json()["status"]["stopped"]
    assert client.put("/v1/dome/light", json={"light": 2}).json()["lit"] == [2]
    assert not client.get("/v1/dome").json()["status"]["stopped"]


def test_a_light_that_was_asked_for_before_all_off_does_not_come_after_it(
    shared_dome: Address, observer: DomeObserver
) -> None:
    with console(shared_dome) as answer:
        assert answer(number=2, do="off").code is None
        assert answer(number=1, do="light", light=0, level=0.1, on_s=5).code == "rig-stopped"
        assert observer.status().stopped
        assert answer(number=3, do="light", light=0, level=0.1, on_s=5).code is None


class Seen:
    """Reads the dome's outputs all the time in a thread of its own."""

    def __init__(self, address: Address) -> None:
        self._observer, self._ending = DomeObserver(*address), threading.Event()
        self.lit_at_s: list[float] = []
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._ending.is_set():
            asked_s = time.monotonic()
            if self._observer.outputs().any():
                self.lit_at_s.append(asked_s)

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self._observer.close()


def test_all_off_stops_a_capture_and_no_light_is_seen_after_it(
    client: httpx.Client, shared_dome: Address, observer: DomeObserver, jobs: Jobs, tmp_path: Path
) -> None:
    jobs.run = capture
    wanted = rig(tmp_path, dome=f"{shared_dome[0]}:{shared_dome[1]}", exposure_s=0.1)
    job = client.post("/v1/jobs", json={"rig": wanted}).json()["id"]
    wait_until(lambda: client.get(f"/v1/jobs/{job}").json()["stages"][0]["done"] > 0.2)
    seen = Seen(shared_dome)
    try:
        wait_until(lambda: bool(seen.lit_at_s))
        answer = client.post("/v1/dome/off").json()
        off_s = time.monotonic()
        assert answer["stopped"] == [job]
        ended = client.get(f"/v1/jobs/{job}/events").text
        # The stop came either between two frames or during one, and the job's end states which.
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "CANCELLED" or '"code":"rig-stopped"' in ended, ended[
            -600:
        ]
    finally:
        seen.close()
    assert not [at for at in seen.lit_at_s if at > off_s]
    done = client.get(f"/v1/jobs/{job}").json()["stages"][0]["done"]
    assert 0.2 < done < 1, "what was acknowledged is kept and the rest is missing"
    assert client.post(f"/v1/jobs/{job}/retry").status_code == 202
    assert "Resuming" in client.get(f"/v1/jobs/{job}/events").text
    assert client.get(f"/v1/jobs/{job}").json()["state"] == "SUCCEEDED"


@pytest.mark.parametrize("then", [lambda dome: dome.light(1, 0.1, 0.01), lambda dome: dome.confirm()])
def test_all_off_tells_whoever_drives_the_dome(
    client: httpx.Client, shared_dome: Address, observer: DomeObserver, then: Callable[[ModbusDome], object]
) -> None:
    with ModbusDome(*shared_dome, ExposureBudget(10, 10), WATCHDOG_S) as dome:
        dome.light(0, 0.1, 0.01)
        client.post("/v1/dome/off").raise_for_status()
        with pytest.raises(RigStoppedError, match="ALL OFF"):
            then(dome)
    assert lit(observer) == ()


def console_of(server: int) -> psutil.Process:
    """The process of a server that drives its dome."""
    return next(child for child in psutil.Process(server).children() if "services.capture.console" in child.cmdline())


def test_all_off_ends_a_process_that_hangs(
    client: httpx.Client, observer: DomeObserver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.api.dome.dome.OFF_S", 0.5)
    client.put("/v1/dome/light", json={"light": 3, "on_s": 30}).raise_for_status()
    hanging = console_of(os.getpid())
    hanging.suspend()
    assert client.post("/v1/dome/off").json()["status"]["lit"] == []
    assert lit(observer) == ()
    assert not hanging.is_running()


def test_of_two_all_offs_at_once_the_later_one_holds(
    shared_dome: Address, observer: DomeObserver, monkeypatch: pytest.MonkeyPatch
) -> None:
    later: list[threading.Thread] = []
    with console(shared_dome) as answer:

        def compare_slowly(*numbers: int) -> int:
            if not later:
                later.append(threading.Thread(target=lambda: answer(number=7, do="off")))
                later[0].start()
                # Code that waits until the order is written waits for all of this time.
                later[0].join(1)
            return max(numbers)

        monkeypatch.setattr("services.capture.console.max", compare_slowly, raising=False)
        assert answer(number=5, do="off").code is None
        later[0].join()
        assert answer(number=6, do="light", light=0, level=0.1, on_s=1).code == "rig-stopped"
        assert lit(observer) == ()
        assert answer(number=8, do="light", light=0, level=0.1, on_s=1).code is None


def test_all_off_darkens_a_dome_that_is_late_to_say_what_it_is(
    shared_dome: Address, observer: DomeObserver, monkeypatch: pytest.MonkeyPatch
) -> None:
    late_s = 3.0
    for module in ("all_off", "controller", "driver"):
        monkeypatch.setattr(f"services.capture.dome.{module}.REPLY_TIMEOUT_S", 4 * late_s)
    # Run each command in a thread of its own, as the dome's process does.
    with console(shared_dome) as answer, ThreadPoolExecutor(2) as threads:
        assert threads.submit(answer, do="light", light=0, level=0.1, on_s=20).result().code is None
        order_fault(*shared_dome, FaultKind.DELAY, round(1000 * late_s), on=reg.IDENTITY)
        asked_s = time.monotonic()
        off = threads.submit(answer, number=2, do="off")
        wait_until(lambda: not observer.outputs().any())
        assert time.monotonic() < asked_s + late_s, "it was dark only once the dome had said that it is one"
        assert off.result().code is None
        assert observer.status().stopped
