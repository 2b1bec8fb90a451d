"""SIGKILL and orderly stops of the server in mid-job: the job and its history survive, and the next server finishes the
job.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import httpx
import pytest

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.live_server import serving, toy_server
from tests.support.toy_server import ROUND_S
from tests.support.toy_stages import run_here


class Server:
    """The server of one data folder, which tests kill or stop and start again."""

    def __init__(self, data: Path) -> None:
        self.data, self._running = data, ExitStack()
        self._process: subprocess.Popen[str] | None = None
        self._client: httpx.Client | None = None

    @property
    def client(self) -> httpx.Client:
        """A client of the running server, which is started if it does not run."""
        if self._client is None:
            self._client, self._process = self._running.enter_context(toy_server(self.data))
        return self._client

    def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait()
        self.stop()

    def stop(self) -> None:
        """End the server in order, if it still runs."""
        self._running.close()
        self._client = None


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("data"))
    yield server
    server.stop()


@contextmanager
def next_server(data: Path) -> Iterator[httpx.Client]:
    """A server in this process that goes on with the jobs of the data folder, without workers."""
    with (
        patch("services.api.jobs.runner.ROUND_S", ROUND_S),
        serving(create_app(ServerSettings(data=data), run_here)) as client,
    ):
        yield client


def submit(client: httpx.Client, data: Path, hold: str, **options: Any) -> tuple[str, Path]:
    """Submit a job that waits in a stage; returns its id and folder."""
    job = client.post("/v1/jobs", json={"workers": 1, **options}).json()["id"]
    folder = data / "jobs" / job
    folder.mkdir(parents=True, exist_ok=True)
    (folder / hold).touch()
    return job, folder


def event_ids(client: httpx.Client, job: str, *, until: str) -> list[int]:
    """Ids of the job's events, read from the stream until a line contains the text ``until``."""
    ids = []
    with client.stream("GET", f"/v1/jobs/{job}/events") as response:
        for line in response.iter_lines():
            if line.startswith("id: "):
                ids.append(int(line.removeprefix("id: ")))
            if until in line:
                break
    return ids


def test_a_cancel_stops_a_running_job_and_a_retry_resumes_it(server: Server) -> None:
    client = server.client
    job, folder = submit(client, server.data, "hold-fit", capture="/")
    event_ids(client, job, until='"kind":"step"')
    assert client.post(f"/v1/jobs/{job}/cancel").json()["state"] == "CANCELLING"
    event_ids(client, job, until="event: end")
    assert client.get(f"/v1/jobs/{job}").json()["state"] == "CANCELLED"
    (folder / "hold-fit").unlink()
    assert client.post(f"/v1/jobs/{job}/retry").json()["state"] in {"QUEUED", "RUNNING"}
    event_ids(client, job, until="event: end")
    detail = client.get(f"/v1/jobs/{job}").json()
    assert detail["state"] == "SUCCEEDED"
    assert [stage["attempt"] for stage in detail["stages"]] == [1, 2, 1]


def test_a_killed_server_loses_neither_job_nor_history(server: Server) -> None:
    job, folder = submit(server.client, server.data, "hold-fit", capture="/")
    before = event_ids(server.client, job, until='"kind":"step"')
    server.kill()
    (folder / "hold-fit").unlink()

    with next_server(server.data) as client:
        after = event_ids(client, job, until="event: end")
        detail = client.get(f"/v1/jobs/{job}").json()
    assert after[: len(before)] == before
    assert detail["state"] == "SUCCEEDED"
    assert {stage["stage"]: stage["attempt"] for stage in detail["stages"]} == {"prepare": 1, "fit": 2, "export": 1}
    assert (folder / "fit" / "by.txt").read_text() == "2\n"


@pytest.mark.dear("Two servers are started.")
def test_stopping_the_server_darkens_the_dome_and_queues_the_job(server: Server) -> None:
    job, folder = submit(server.client, server.data, "hold-capture", rig={"mouth": "/"})
    event_ids(server.client, job, until='"stage":"capture","kind":"started"')
    while not (folder / "lit").exists():
        time.sleep(0.02)
    server.stop()
    assert not (folder / "lit").exists()
    (folder / "hold-capture").unlink()

    with next_server(server.data) as client:
        event_ids(client, job, until="event: end")
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "SUCCEEDED"
