"""Protection of the host: workers on loopback refuse other users of the machine, only the service's user can read its
files, and no client can occupy all connections.
"""

from __future__ import annotations

import asyncio
import errno
import http.client
import json
import os
import shutil
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from services.api.http.connections import ConnectionLimiter
from services.cli import dask as dask_command
from services.core.settings import ConnectionLimits
from services.pipeline.workers import Workers
from tests.support.live_server import toy_server
from tests.support.uploading import contents_of, upload_capture, write_capture

NOBODY = 65534
PYTHON = shutil.which("python3", path=os.defpath) or sys.executable
"""The system's Python, because another user may have no access to the folder of this one."""
OTHER_USER: dict[str, Any] = {} if os.geteuid() else {"user": NOBODY, "group": NOBODY, "extra_groups": []}
"""Options of a subprocess that run it as another user. This needs root; without root the test uses the same user, who
must be refused too."""
PLACES, HEADER_S = 12, 1.0
"""Number of connections of the tested server, and the time that each may take for the head of a request."""
STRANGER = Path(__file__).parents[1] / "containers" / "stranger.py"


def listening() -> set[int]:
    """Ports on which this process and its child processes listen."""
    here = psutil.Process()
    those = [here, *here.children(recursive=True)]
    return {
        one.laddr.port
        for process in those
        for one in process.net_connections("tcp")
        if one.status == psutil.CONN_LISTEN
    }


@pytest.mark.attack("Dask and files as another user", "every port of the workers, as another user")
def test_whoever_shows_no_certificate_is_refused_on_every_port() -> None:
    before = listening()
    with Workers() as workers, workers.serving(1) as client:
        assert client.submit(sum, [1, 2]).result(timeout=60) == 3
        opened = listening() - before
        assert len(opened) >= 2  # scheduler and worker
        targets = json.dumps([["127.0.0.1", port] for port in opened])
        told = subprocess.run(
            [PYTHON, "-c", STRANGER.read_text(), targets],
            capture_output=True,
            text=True,
            check=True,
            cwd="/",
            **OTHER_USER,
        )
        assert set(json.loads(told.stdout).values()) == {"tls refuses"}, told.stdout


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, Path]]:
    """A server with few connections and a simulated dome, started with a umask that lets others read files."""
    data, log = tmp_path_factory.mktemp("host") / "data", tmp_path_factory.mktemp("log") / "server.log"
    before = os.umask(0o022)
    try:
        with log.open("w") as stream:
            limits = {"most": PLACES, "header_s": HEADER_S}
            with toy_server(data, stream, connections=limits, dome={"address": "simulated", "watchdog_s": 60}) as (
                client,
                _,
            ):
                yield client, data
    finally:
        os.umask(before)


@pytest.mark.dear("A service of several processes is started.")
@pytest.mark.attack("Dask and files as another user", "files of the service and its workers")
def test_what_the_service_and_its_workers_write_is_for_its_user_alone(
    served: tuple[httpx.Client, Path], tmp_path: Path
) -> None:
    client, data = served
    capture = upload_capture(client, contents_of(write_capture(tmp_path / "capture")))
    job = client.post("/v1/jobs", json={"capture": f"captures/{capture}", "workers": 1}).json()["id"]
    assert client.get(f"/v1/jobs/{job}/events", timeout=120).text.rstrip().endswith('"SUCCEEDED"')
    client.put("/v1/calibrations/rig", json=client.get(f"/v1/captures/{capture}/calibration").json())
    written = [data, *data.rglob("*")]
    assert {"prepared", "dentine.sqlite", "capture.json", "names"} <= {path.name for path in written}
    assert [str(path) for path in written if stat.S_IMODE(path.lstat().st_mode) & 0o077] == []


@pytest.mark.attack("Dask and files as another user", "files of workers of their own")
def test_what_is_started_for_dask_inherits_a_private_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    masks: list[int] = []
    before = os.umask(0o022)

    def become(*_: object) -> None:
        masks.append(os.umask(0o022))
        raise SystemExit

    monkeypatch.setattr(os, "execve", become)
    try:
        for part in ("scheduler", "worker"):
            with pytest.raises(SystemExit):
                dask_command._exec_dask(part, ["tcp://127.0.0.1:9"], None)
    finally:
        os.umask(before)
    assert masks == [0o077] * 2


def half_open(address: httpx.URL, count: int) -> list[socket.socket]:
    """Open connections that begin a request and never end its head."""
    opened = [socket.create_connection((address.host, address.port or 80), timeout=20) for _ in range(count)]
    for one in opened:
        one.sendall(b"POST /v1/dome/off HTTP/1.1\r\nHost: 127.0.0.1\r\nX-More: ")
    return opened


@pytest.mark.attack("exhaustion", "more half-open connections than there are places")
def test_half_open_connections_keep_nobody_from_all_off(served: tuple[httpx.Client, Path]) -> None:
    client, _ = served
    known = http.client.HTTPConnection(client.base_url.host, client.base_url.port, timeout=20)
    known.request("GET", "/v1/health/live")
    assert known.getresponse().read()
    kept = known.sock
    opened = half_open(client.base_url, 3 * PLACES)
    try:
        known.request("GET", "/v1/health/live")  # connections with an earlier request are closed last
        assert known.getresponse().status == 200
        assert known.sock is kept
        for _ in range(3):
            with httpx.Client(base_url=client.base_url, timeout=20) as newcomer:
                assert newcomer.post("/v1/dome/off").status_code == 200
        closed = [one for one in opened[:PLACES] if is_closed(one)]
        assert len(closed) == PLACES  # the connections that have waited longest
    finally:
        known.close()
        for one in opened:
            one.close()


def is_closed(connection: socket.socket) -> bool:
    connection.settimeout(20)
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.attack("exhaustion", "a head that never ends")
def test_a_request_whose_head_does_not_end_is_given_up_whatever_is_sent_of_it(
    served: tuple[httpx.Client, Path],
) -> None:
    client, _ = served
    began = time.monotonic()
    (slow,) = half_open(client.base_url, 1)
    with slow:
        slow.settimeout(0.05)
        answer, until = b"", began + 30 * HEADER_S
        while not answer and time.monotonic() < until:
            try:
                slow.sendall(b"x")  # a byte now and then must not restart the time limit
                answer = slow.recv(4096) or b"closed"
            except TimeoutError:
                continue
            except (ConnectionResetError, BrokenPipeError):
                answer = b"closed"
        assert time.monotonic() - began >= HEADER_S
    assert answer.startswith((b"HTTP/1.1 408", b"closed")), answer


@pytest.mark.attack("exhaustion", "a log that grows by an accept without descriptors")
def test_a_lack_of_descriptors_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    async def run_out() -> int:
        loop, limiter = asyncio.get_running_loop(), ConnectionLimiter(ConnectionLimits())
        loop.set_exception_handler(limiter.handle_exception)
        context = {
            "message": "socket.accept() out of system resource",
            "exception": OSError(errno.EMFILE, "Too many open files"),
        }
        for _ in range(5000):
            loop.call_exception_handler(context)
        told = len(caplog.records)
        loop.call_exception_handler({"message": "another", "exception": ValueError("x")})
        return told

    assert asyncio.run(run_out()) == 1
    assert "raise the limit of open files" in caplog.records[0].getMessage()
    assert len(caplog.records) == 2
