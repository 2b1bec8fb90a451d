"""SIGKILL and orderly stops of the server in mid-job: the job and its history survive, and the next server finishes the
job.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import httpx

from tests.support.live_server import toy_server


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


def test_a_killed_server_loses_neither_job_nor_history(tmp_path: Path) -> None:
    with toy_server(tmp_path) as (client, process):
        job, folder = submit(client, tmp_path, "hold-fit", capture="/")
        before = event_ids(client, job, until='"kind":"step"')
        process.kill()
        process.wait()
    (folder / "hold-fit").unlink()

    with toy_server(tmp_path) as (client, _):
        after = event_ids(client, job, until="event: end")
        detail = client.get(f"/v1/jobs/{job}").json()
    assert after[: len(before)] == before
    assert detail["state"] == "SUCCEEDED"
    assert {stage["stage"]: stage["attempt"] for stage in detail["stages"]} == {"prepare": 1, "fit": 2, "export": 1}
    assert (folder / "fit" / "by.txt").read_text() == "2\n"


def test_stopping_the_server_darkens_the_dome_and_queues_the_job(tmp_path: Path) -> None:
    with toy_server(tmp_path) as (client, _):
        job, folder = submit(client, tmp_path, "hold-capture", rig={"mouth": "/"})
        event_ids(client, job, until='"stage":"capture","kind":"started"')
        while not (folder / "lit").exists():
            time.sleep(0.02)
    assert not (folder / "lit").exists()
    (folder / "hold-capture").unlink()

    with toy_server(tmp_path) as (client, _):
        event_ids(client, job, until="event: end")
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "SUCCEEDED"


def test_a_cancel_stops_a_running_job_and_a_retry_resumes_it(tmp_path: Path) -> None:
    with toy_server(tmp_path) as (client, _):
        job, folder = submit(client, tmp_path, "hold-fit", capture="/")
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
