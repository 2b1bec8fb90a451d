"""The dome by hand over the API: a real server, its real process, a simulated dome in a third one."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from services.api.app import create_app
from services.api.auth.tokens import Scope
from services.api.http.problems import status_of
from services.capture import stage
from services.capture.console import Console
from services.capture.dome import registers as reg
from services.capture.dome.controller import DomeObserver
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FaultBit, FaultKind
from services.capture.dome.simulator import order_fault, simulated_dome
from services.core.dome import DomeAnswer, DomeCommand
from services.core.errors import RigStoppedError, RigUnreachableError
from services.core.records import JobSpec
from services.core.settings import DomeSettings, ServerSettings
from services.core.stage import LocalContext
from services.pipeline.event_log import EventAddress
from tests.support.guarded_server import guarded
from tests.support.live_server import serving
from tests.support.mouth import write_mouth
from tests.support.small_system import free_port

LIGHTS = 6
WATCHDOG_S = 10.0
Address = tuple[str, int]


@pytest.fixture(scope="module")
def shared_dome() -> Iterator[Address]:
    with simulated_dome(LIGHTS, WATCHDOG_S) as address:
        yield address


@pytest.fixture
def observer(shared_dome: Address) -> Iterator[DomeObserver]:
    order_fault(*shared_dome, FaultKind.NONE)
    observer = DomeObserver(*shared_dome)
    yield observer
    order_fault(*shared_dome, FaultKind.NONE)
    observer.close()


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


@pytest.fixture(scope="module")
def jobs() -> Jobs:
    return Jobs()


@pytest.fixture(scope="module")
def shared_client(shared_dome: Address, jobs: Jobs, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(settings_of(shared_dome, tmp_path_factory.mktemp("data")), jobs)) as client:
        yield client


@pytest.fixture
def client(shared_client: httpx.Client, observer: DomeObserver) -> Iterator[httpx.Client]:
    yield shared_client
    shared_client.delete("/v1/dome/light")
    assert lit(observer) == ()


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


def test_one_light_goes_on_is_seen_and_goes_off(client: httpx.Client, observer: DomeObserver) -> None:
    assert client.get("/v1/dome").json()["status"]["lit"] == []
    assert client.put("/v1/dome/light", json={"light": 3, "level": 0.1, "on_s": 30}).json()["lit"] == [3]
    assert lit(observer) == (3,)
    assert client.put("/v1/dome/light", json={"light": 4, "level": 0.1, "on_s": 30}).json()["lit"] == [4]
    state = client.get("/v1/dome").json()
    assert (state["status"]["light_count"], state["status"]["lit"], state["status"]["stopped"], state["capturing"]) == (
        LIGHTS,
        [4],
        False,
        [],
    )
    assert client.delete("/v1/dome/light").json()["lit"] == []
    assert lit(observer) == ()


def test_a_light_that_nobody_asks_for_again_goes_dark(client: httpx.Client, observer: DomeObserver) -> None:
    client.put("/v1/dome/light", json={"light": 1, "on_s": 0.3})
    began_s = time.monotonic()
    client.put("/v1/dome/light", json={"light": 1, "on_s": 0.8}).raise_for_status()
    wait_until(lambda: lit(observer) == ())
    assert time.monotonic() - began_s >= 0.8, "the renewed light went dark before its time"
    # By its own process, not by the controller's watchdog.
    assert observer.faults() == FaultBit(0)


def test_all_off_holds_until_somebody_starts_anew(client: httpx.Client, observer: DomeObserver) -> None:
    client.put("/v1/dome/light", json={"light": 2, "on_s": 30})
    answer = client.post("/v1/dome/off").json()
    assert (answer["status"]["lit"], answer["status"]["stopped"], answer["stopped"]) == ([], True, [])
    assert lit(observer) == ()
    assert client.get("/v1/dome").json()["status"]["stopped"]
    assert client.put("/v1/dome/light", json={"light": 2}).json()["lit"] == [2]
    assert not client.get("/v1/dome").json()["status"]["stopped"]


@pytest.mark.parametrize(
    ("wanted", "named"),
    [
        ({"light": LIGHTS}, f"Light {LIGHTS} does not exist, the dome has lights 0 to {LIGHTS - 1}"),
        ({"light": -1}, "'light'"),
        ({"light": 1, "on_s": 31}, "'on_s'"),
        ({"light": 1, "level": 1.5}, "'level'"),
        ({"light": 1, "level": True}, "'level'"),
        ({"light": "1"}, "'light'"),
        ({}, "'light'"),
    ],
)
def test_a_light_that_cannot_be_is_refused_in_the_dark(
    client: httpx.Client, observer: DomeObserver, wanted: dict[str, float], named: str
) -> None:
    answer = client.put("/v1/dome/light", json=wanted)
    assert problem_of(answer) == (422, "bad-settings")
    assert named in answer.json()["detail"]
    assert lit(observer) == ()


@contextmanager
def console(address: Address, **limits: float) -> Iterator[Callable[..., DomeAnswer]]:
    """The dome's process without a process around it."""
    console = Console(*address, DomeSettings(watchdog_s=WATCHDOG_S, **limits))
    try:
        yield lambda **command: console.answer(DomeCommand(**{"number": 1} | command))
    finally:
        console.close()


def test_light_by_hand_adds_up_to_the_limit(shared_dome: Address, observer: DomeObserver) -> None:
    with console(shared_dome, light_exposure_limit_s=1.5) as answer:
        assert answer(do="light", light=0, level=0.1, on_s=14.9).code is None
        lit_s = time.monotonic()
        wait_until(lambda: time.monotonic() > lit_s + 0.2)
        answer(do="dark")
        # What was on adds 0.02 level-seconds at least; another light has had none.
        assert answer(do="light", light=0, level=0.1, on_s=14.9).code == "rig-exposure-limit"
        assert lit(observer) == ()
        assert answer(do="light", light=1, level=0.1, on_s=14.9).code is None


def test_a_light_that_was_asked_for_before_all_off_does_not_come_after_it(
    shared_dome: Address, observer: DomeObserver
) -> None:
    with console(shared_dome) as answer:
        assert answer(number=2, do="off").code is None
        assert answer(number=1, do="light", light=0, level=0.1, on_s=5).code == "rig-stopped"
        assert observer.status().stopped
        assert answer(number=3, do="light", light=0, level=0.1, on_s=5).code is None


def test_a_dome_that_does_not_answer_is_a_sentence() -> None:
    with console(("127.0.0.1", free_port())) as answer:
        for command in ("status", "off", "light"):
            told = answer(do=command, level=0.1, on_s=1)
            assert told.code == "rig-unreachable", command
            assert re.search("(check|press) (its|the)", told.message), told.message
    assert status_of(RigUnreachableError("")) == 503


def test_an_open_interlock_is_a_sentence(client: httpx.Client, shared_dome: Address) -> None:
    order_fault(*shared_dome, FaultKind.INTERLOCK_OPEN)
    assert problem_of(client.put("/v1/dome/light", json={"light": 0})) == (409, "rig-interlock")
    assert client.get("/v1/dome").json()["status"]["interlock_closed"] is False
    assert client.post("/v1/dome/off").status_code == 200


def test_a_server_without_a_dome_says_so(tmp_path: Path) -> None:
    with serving(create_app(ServerSettings(data=tmp_path))) as client:
        for method, path, body in (
            ("GET", "", None),
            ("POST", "/off", None),
            ("PUT", "/light", {"light": 0}),
            ("DELETE", "/light", None),
        ):
            answer = client.request(method, f"/v1/dome{path}", json=body)
            assert problem_of(answer) == (404, "dome-unknown"), path
            assert "DENTINE__SERVER__DOME__ADDRESS" in answer.json()["detail"]


def test_without_the_packages_of_the_dome_the_server_says_so(
    shared_dome: Address, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with serving(create_app(settings_of(shared_dome, tmp_path))) as client:
        answer = client.get("/v1/dome")
        assert problem_of(answer) == (503, "platform-missing")
        assert "dentine[capture]" in answer.json()["detail"]


def test_the_dome_asks_for_its_scope_and_is_audited(
    shared_dome: Address, observer: DomeObserver, tmp_path: Path
) -> None:
    with guarded(tmp_path, dome=settings_of(shared_dome, tmp_path).dome) as server:
        assert server.ask("GET", "/v1/dome", Scope.OPERATE_DOME).status_code == 200
        assert server.ask("PUT", "/v1/dome/light", Scope.OPERATE_DOME, json={"light": 5}).status_code == 200
        assert problem_of(server.ask("POST", "/v1/dome/off", Scope.SUBMIT)) == (403, "scope-missing")
        assert lit(observer) == (5,)
        assert server.ask("POST", "/v1/dome/off", Scope.OPERATE_DOME).status_code == 200
        entries = server.ask("GET", "/v1/audit", Scope.ADMIN).json()["entries"]
        told = [(entry["who"], entry["action"], entry["outcome"]) for entry in entries if "/dome" in entry["action"]]
        assert told[::-1] == [
            ("of-operate-dome", "PUT /v1/dome/light", 200),
            ("of-submit", "POST /v1/dome/off", 403),
            ("of-operate-dome", "POST /v1/dome/off", 200),
        ]


def test_a_preflight_tells_what_it_finds(
    client: httpx.Client, observer: DomeObserver, shared_dome: Address, tmp_path: Path
) -> None:
    assert client.post("/v1/dome/preflight", json=rig(tmp_path)).json() == {"findings": []}
    assert lit(observer) == ()
    order_fault(*shared_dome, FaultKind.DEAD_LIGHT, 4)
    answer = client.post("/v1/dome/preflight", json=rig(tmp_path))
    assert problem_of(answer) == (502, "rig-readback")
    assert "Light 4" in answer.json()["detail"]
    for wrong, named in (
        ({"mouth": "mouth"}, "relative"),
        ({"mouth": "/no/such"}, "does not exist"),
        ({"dome": "other:5020"}, "and no other"),
    ):
        answer = client.post("/v1/dome/preflight", json=rig(tmp_path) | wrong)
        assert problem_of(answer) == (422, "bad-settings")
        assert named in answer.json()["detail"]


def test_all_off_ends_a_preflight(client: httpx.Client, observer: DomeObserver, tmp_path: Path) -> None:
    answers: list[httpx.Response] = []
    # A black and a lit frame of seconds each, so that it is certainly under way.
    wanted = rig(tmp_path, exposure_s=2.0, level=0.1)
    asking = threading.Thread(target=lambda: answers.append(client.post("/v1/dome/preflight", json=wanted)))
    asking.start()
    wait_until(lambda: lit(observer) != ())
    assert problem_of(client.put("/v1/dome/light", json={"light": 0})) == (409, "dome-busy")
    assert client.post("/v1/dome/off").json()["status"]["lit"] == []
    asking.join()
    assert problem_of(answers[0]) == (409, "rig-stopped")
    assert lit(observer) == ()


def test_a_capture_has_the_dome_for_itself(
    client: httpx.Client, observer: DomeObserver, jobs: Jobs, tmp_path: Path
) -> None:
    begun, go = threading.Event(), threading.Event()
    jobs.run = lambda *_: (begun.set(), go.wait(60))
    client.put("/v1/dome/light", json={"light": 2, "on_s": 30}).raise_for_status()
    job = client.post("/v1/jobs", json={"rig": rig(tmp_path)}).json()["id"]
    try:
        assert begun.wait(60)
        assert lit(observer) == (), "the light by hand outlived the beginning of the capture"
        for path, method, body in (("light", "PUT", {"light": 2}), ("preflight", "POST", rig(tmp_path))):
            answer = client.request(method, f"/v1/dome/{path}", json=body)
            assert problem_of(answer) == (409, "dome-busy")
            assert job in answer.json()["detail"]
        assert client.get("/v1/dome").json()["capturing"] == [job]
        assert client.delete("/v1/dome/light").status_code == 200
        queued = client.post("/v1/jobs", json={"rig": rig(tmp_path)}).json()["id"]
        other = client.post("/v1/jobs", json={"capture": str(tmp_path)}).json()["id"]
        assert client.post("/v1/dome/off").json()["stopped"] == [queued, job]
        states = [client.get(f"/v1/jobs/{one}").json()["state"] for one in (job, queued, other)]
        assert states[:2] == ["CANCELLING", "CANCELLED"], "the next capture in the queue would light the dome again"
        assert states[2] in {"QUEUED", "RUNNING"}, "a job that does not capture is left alone"
    finally:
        go.set()
        client.get(f"/v1/jobs/{other}/events")


class Seen:
    """Looks at the dome all the time from a thread of its own."""

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


def capture(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """The real capture, without a worker around it."""
    with events.open() as log:
        attempt = log.begin_stage("capture")
        stage.run(spec, LocalContext(folder, attempt, lambda event: log.append(attempt, event)))


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
        # Whether it stood between two frames or in one: it says which.
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
    """The dome's process of a server."""
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
                # Whoever waits for the order to be written takes all of this time.
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
    for module in ("services.capture.dome.controller", "services.capture.dome.driver"):
        monkeypatch.setattr(f"{module}.REPLY_TIMEOUT_S", 4 * late_s)
    # As the process does it, each command in a thread of its own.
    with console(shared_dome) as answer, ThreadPoolExecutor(2) as threads:
        assert threads.submit(answer, do="light", light=0, level=0.1, on_s=20).result().code is None
        order_fault(*shared_dome, FaultKind.DELAY, round(1000 * late_s), on=reg.IDENTITY)
        asked_s = time.monotonic()
        off = threads.submit(answer, number=2, do="off")
        wait_until(lambda: not observer.outputs().any())
        assert time.monotonic() < asked_s + late_s, "it was dark only once the dome had said that it is one"
        assert off.result().code is None
        assert observer.status().stopped
