"""ALL OFF and cancels are answered while all other requests hang, and the server's event loop goes on meanwhile."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from pydantic import TypeAdapter

from services.api.app import create_app
from services.api.http import problems
from services.api.http.bodies import MAX_FAULTS
from services.api.jobs.jobs import Jobs
from services.api.jobs.repository import Repository
from services.capture.dome.simulator import simulated_dome
from services.core.errors import DentineError
from services.core.settings import DomeSettings, ServerSettings
from tests.support.live_server import serving

LIGHTS = 6
EACH = 45
"""Number of hanging requests of each kind, larger than any thread pool: FastAPI calls plain handlers in forty
threads."""
PATIENCE_S = 30.0
ANSWERED_WITHIN_S = 20.0
"""Time limit of a request that must not wait for the requests that hang for a minute."""
BODY_BYTES = 2**20
"""Default size limit of a request body."""
TURNS, LOOP_PATIENCE_S = 10, 10.0
"""Number of turns that the event loop must make while another function works, and time limit for them."""
POOLS = (1, 1, min(32, (os.cpu_count() or 1) + 4), 40)
"""Sizes of the thread pools that read the database, open files, run blocking calls of coroutines (asyncio's default)
and call plain handlers (FastAPI's)."""
TUS = "Tus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\nContent-Type: application/offset+octet-stream\r\n"


class Hanging:
    """Replaces functions by one that does not return until the test ends it."""

    def __init__(self) -> None:
        self.is_over, self.begun = threading.Event(), 0
        self._lock = threading.Lock()

    def __call__(self, *_: Any, **__: Any) -> Any:
        with self._lock:
            self.begun += 1
        self.is_over.wait(PATIENCE_S)
        raise DentineError("It hung.")


@pytest.fixture
def hanging() -> Iterator[Hanging]:
    hanging = Hanging()
    yield hanging
    hanging.is_over.set()


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.01)


def occupy(address: str, job: str) -> ExitStack:
    """Send ``EACH`` requests of every kind that occupies threads: reading jobs and files, sending and committing
    captures, deleting jobs.
    """
    host, port = address.removeprefix("http://").split(":")
    kinds = [
        f"GET /v1/jobs HTTP/1.1\r\nHost: {host}\r\n\r\n",
        f"GET /v1/jobs/{job}/artifacts HTTP/1.1\r\nHost: {host}\r\n\r\n",
        f"GET /v1/jobs/{job}/artifacts.zip HTTP/1.1\r\nHost: {host}\r\n\r\n",
        f"POST /v1/captures/absent/commit HTTP/1.1\r\nHost: {host}\r\n\r\n",
        f"DELETE /v1/jobs/{job} HTTP/1.1\r\nHost: {host}\r\n\r\n",
        f"PATCH /v1/uploads/absent/NUMBER HTTP/1.1\r\nHost: {host}\r\nContent-Length: 1\r\n{TUS}\r\nx",
    ]
    with ExitStack() as connections:
        for number in range(EACH):
            for kind in kinds:
                connections.enter_context(socket.create_connection((host, int(port)))).sendall(
                    kind.replace("NUMBER", str(number)).encode()
                )
        return connections.pop_all()


@pytest.mark.attack("exhaustion", "every thread of the server hanging")
def test_all_off_and_cancel_are_answered_while_all_other_threads_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hanging: Hanging
) -> None:
    begun, go = threading.Event(), threading.Event()
    with simulated_dome(LIGHTS, 10.0) as (host, port):
        settings = ServerSettings(data=tmp_path / "data", dome=DomeSettings(address=f"{host}:{port}", watchdog_s=10.0))

        def run(*_: object) -> None:
            begun.set()
            go.wait(PATIENCE_S)

        app = create_app(settings, run)
        with serving(app) as client:
            job = client.post("/v1/jobs", json={"capture": "/"}).raise_for_status().json()["id"]
            assert begun.wait(PATIENCE_S)
            client.put("/v1/dome/light", json={"light": 3, "level": 0.1, "on_s": 30}).raise_for_status()
            for owner, name in ((Repository, "page"), (Jobs, "delete")):
                monkeypatch.setattr(owner, name, hanging)
            for place in (
                "services.api.jobs.routes.list_artifacts",
                "services.api.jobs.history_routes.list_artifacts",
                "services.api.captures.uploads.Uploads.begin",
                "services.api.captures.captures.Captures.commit",
            ):
                monkeypatch.setattr(place, hanging)
            monkeypatch.setattr("services.api.jobs.jobs.Jobs.capturing", lambda _: [])
            with occupy(str(client.base_url), job):
                wait_until(lambda: hanging.begun >= sum(POOLS))
                client.timeout = httpx.Timeout(ANSWERED_WITHIN_S)
                assert client.get("/v1/dome").json()["status"]["lit"] == [3]
                assert client.post("/v1/dome/off").json()["status"]["lit"] == []
                assert client.post(f"/v1/jobs/{job}/cancel").json()["state"] == "CANCELLING"
                assert client.put("/v1/dome/light", json={"light": 2, "level": 0.1, "on_s": 30}).json()["lit"] == [2]
                assert hanging.begun == sum(POOLS), "what was to occupy the threads has left them"
                hanging.is_over.set()
                go.set()


@dataclass
class Looped:
    """A server whose event loop counts its turns, and the errors of the tested function."""

    client: httpx.Client
    job: str
    turns: int = 0
    listed: list[int] = field(default_factory=list)
    built: list[object] = field(default_factory=list)
    """Types whose validators were built for the first request."""

    async def count_turns(self) -> None:
        """Count the turns of the event loop, for ever."""
        while True:
            await asyncio.sleep(0)
            await asyncio.sleep(0.001)
            self.turns += 1


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Looped]:
    app = create_app(ServerSettings(data=tmp_path_factory.mktemp("data")), lambda *_: None)
    looped, lifespan = Looped(httpx.Client(), ""), app.router.lifespan_context

    @asynccontextmanager
    async def counting(served: FastAPI) -> AsyncIterator[Any]:
        async with lifespan(served) as state:
            task = asyncio.create_task(looped.count_turns())
            yield state
            task.cancel()

    app.router.lifespan_context = counting
    with serving(app) as client:
        with pytest.MonkeyPatch.context() as patch:
            build = TypeAdapter._init_core_attrs

            def counted_build(self: TypeAdapter[Any], *given: Any, **named: Any) -> Any:
                looped.built.append(self)
                return build(self, *given, **named)

            patch.setattr(TypeAdapter, "_init_core_attrs", counted_build)
            looped.client, looped.job = client, client.post("/v1/jobs", json={"capture": "/"}).json()["id"]
        yield looped


@pytest.fixture
def loop_server(counted: Looped, monkeypatch: pytest.MonkeyPatch) -> Looped:
    counted.listed = []
    tell = problems._sentence

    def count(errors: Sequence[Any]) -> str:
        counted.listed.append(len(errors))
        return tell(errors)

    monkeypatch.setattr(problems, "_sentence", count)
    return counted


def test_the_first_request_finds_its_route_built(counted: Looped) -> None:
    assert counted.built == [], "the loop built validators while others waited"


def many(item: object) -> str:
    """A JSON list of as many copies of an item as a body may hold."""
    text = json.dumps(item)
    return f"[{','.join([text] * ((BODY_BYTES - 100) // (len(text) + 1)))}]"


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/v1/captures", f'{{"files": {many(0)}}}'),
        ("POST", "/v1/captures", f'{{"files": {many({})}}}'),
        ("POST", "/v1/jobs", f'{{"capture": "/", "channels": {many(0)}}}'),
        ("POST", "/v1/jobs", json.dumps({f"a{number}": 0 for number in range(80_000)})),
        ("POST", "/v1/jobs", many([])),
        ("POST", "/v1/jobs", "[" * BODY_BYTES),
        ("POST", "/v1/jobs", json.dumps({"rig": {f"a{number}": 0 for number in range(20_000)}})),
        ("PUT", "/v1/calibrations/x", f'{{"units": "mm", "channels": [], "lights": [], "cameras": {many({})}}}'),
    ],
)
@pytest.mark.attack("exhaustion", "a body of hundreds of thousands of faults")
def test_a_body_of_many_faults_is_refused_at_its_first_ones(
    loop_server: Looped, method: str, path: str, body: str
) -> None:
    listed = loop_server.listed
    answer = loop_server.client.request(method, path, content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"] == "bad-settings"
    was_parsed = "are allowed" not in answer.json()["detail"]
    assert len(listed) == int(was_parsed), "the faults were told once, or the body was refused before it was parsed"
    assert sum(listed) <= MAX_FAULTS


MANIFEST = {"files": [{"path": f"{number}.png", "bytes": 1, "sha256": "0" * 64} for number in range(200)]}
"""Manifest that is longer than bodies that are parsed on the event loop."""
WAITS_FOR_THE_LOOP: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
    ("services.api.http.bodies.parse", "POST", "/v1/captures", {"json": MANIFEST}),
    ("services.api.captures.captures.Captures.commit", "POST", "/v1/captures/absent/commit", {}),
    (
        "services.api.captures.captures.Captures.create",
        "POST",
        "/v1/captures",
        {"json": {"files": [{"path": "capture.json", "bytes": 1, "sha256": "0" * 64}]}},
    ),
    (
        "services.api.captures.uploads.Uploads.begin",
        "PATCH",
        "/v1/uploads/absent/0",
        {"content": b"x", "headers": dict(line.split(": ") for line in TUS.splitlines())},
    ),
    ("services.api.masks.masks.Masks.put", "PUT", "/v1/jobs/{job}/masks/a/all", {"content": b"x"}),
    (
        "services.api.calibrations.calibrations.Calibrations.put",
        "PUT",
        "/v1/calibrations/x",
        {"json": {"units": "mm", "channels": [], "lights": [], "cameras": []}},
    ),
    ("services.api.jobs.routes.list_artifacts", "GET", "/v1/jobs/{job}/artifacts", {}),
    ("services.api.jobs.routes.open_artifact", "GET", "/v1/jobs/{job}/artifacts/report.html", {}),
    ("services.api.jobs.history_routes.list_artifacts", "GET", "/v1/jobs/{job}/artifacts.zip", {}),
    ("services.api.jobs.history.HistoryCache.read", "GET", "/v1/jobs/{job}/history", {}),
    ("services.api.jobs.event_stream._read", "GET", "/v1/jobs/{job}/events", {}),
    ("services.api.health.worker_routes.list_workers", "GET", "/v1/workers", {}),
    ("services.api.health.readiness.Readiness.checks", "GET", "/v1/health/ready", {}),
)
"""Functions that parse, read or write, and requests that end in them."""


@pytest.mark.parametrize(
    ("place", "method", "path", "sent"), WAITS_FOR_THE_LOOP, ids=[place for place, *_ in WAITS_FOR_THE_LOOP]
)
@pytest.mark.attack("exhaustion", "the event loop held up by a parser")
def test_the_loop_goes_on_while_something_is_parsed_read_or_written(
    loop_server: Looped, monkeypatch: pytest.MonkeyPatch, place: str, method: str, path: str, sent: dict[str, Any]
) -> None:
    has_gone_on: list[bool] = []

    def work_slowly(*_: object) -> object:
        before, deadline_s = loop_server.turns, time.monotonic() + LOOP_PATIENCE_S
        while loop_server.turns < before + TURNS and time.monotonic() < deadline_s:
            time.sleep(0.001)
        has_gone_on.append(loop_server.turns >= before + TURNS)
        raise DentineError("It was slow.")

    monkeypatch.setattr(place, work_slowly)
    loop_server.client.request(method, path.format(job=loop_server.job), **sent)
    assert has_gone_on == [True], f"while {place} worked, the loop that serves everybody stood still"
