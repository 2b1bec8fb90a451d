"""While a disk does not answer, requests that do not need it are still answered."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.live_server import serving

FILE_READERS = 50
"""Number of requests for files, more than the forty threads in which FastAPI calls handlers."""


class Disk:
    """A disk that hangs from the first access until the test mends it."""

    def __init__(self) -> None:
        self.is_asked, self.is_mended = threading.Event(), threading.Event()

    def __call__(self, *_: object) -> None:
        self.is_asked.set()
        self.is_mended.wait(60)

    def list_nothing(self, *_: object) -> list[object]:
        """Hang while the disk hangs, then list an empty folder."""
        self()
        return []


@pytest.fixture
def disk() -> Iterator[Disk]:
    disk = Disk()
    yield disk
    disk.is_mended.set()


def test_a_job_is_told_without_its_time_and_everything_else_as_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: Disk
) -> None:
    monkeypatch.setattr("services.api.jobs.time_ranges.size_of", disk)
    monkeypatch.setattr("services.api.jobs.routes.ESTIMATE_TIMEOUT_S", 0.1)
    with serving(create_app(ServerSettings(data=tmp_path / "data"), lambda *_: disk.is_mended.wait(60))) as client:
        job = submit(client, tmp_path)
        for _ in range(2):  # at the second request the prober still waits for the first
            told = client.get(f"/v1/jobs/{job}").json()
            assert (told["id"], told["remaining"]["low_s"]) == (job, None)
            assert "could not be looked at within 0.1 s" in told["remaining"]["reason"]
        assert disk.is_asked.is_set()
        assert [one["id"] for one in client.get("/v1/jobs").json()["jobs"]] == [job]
        assert client.get(f"/v1/jobs/{job}/logs").status_code == 200
        disk.is_mended.set()
        client.get(f"/v1/jobs/{job}/events")
        assert client.get(f"/v1/jobs/{job}").json()["remaining"] is None


def test_a_job_whose_size_is_being_predicted_can_be_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: Disk
) -> None:
    with serving(create_app(ServerSettings(data=tmp_path / "data"), lambda *_: None)) as client:
        monkeypatch.setattr("services.api.jobs.admission.Admission.refuse_too_large", lambda *_: None)
        monkeypatch.setattr("services.api.jobs.admission.predict", disk)
        job = submit(client, tmp_path)
        assert disk.is_asked.wait(60)
        try:
            assert client.get(f"/v1/jobs/{job}").json()["state"] == "QUEUED"
        finally:
            monkeypatch.undo()
            client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
            disk.is_mended.set()


def test_many_who_wait_for_files_of_jobs_keep_nobody_from_submitting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: Disk
) -> None:
    monkeypatch.setattr("services.api.jobs.routes.list_artifacts", disk.list_nothing)
    with (
        serving(create_app(ServerSettings(data=tmp_path / "data"), lambda *_: None)) as client,
        ThreadPoolExecutor(FILE_READERS) as pool,
    ):
        files = f"{client.base_url}/v1/jobs/{submit(client, tmp_path)}/artifacts"
        waiting = [pool.submit(httpx.get, files, timeout=60) for _ in range(FILE_READERS)]
        assert disk.is_asked.wait(60)
        try:
            for _ in range(3):
                submit(client, tmp_path)
        finally:
            disk.is_mended.set()
        assert [one.result().json() for one in waiting] == [[]] * FILE_READERS


def submit(client: httpx.Client, capture: Path) -> str:
    answer = client.post("/v1/jobs", json={"capture": str(capture)})
    assert answer.status_code == 201, answer.text
    job: str = answer.json()["id"]
    return job
