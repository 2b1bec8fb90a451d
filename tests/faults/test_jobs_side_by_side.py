"""Concurrent jobs: a fit makes neither another job nor a capture wait, a cancel does not affect other jobs, and a
waiting job states its reason.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.live_server import serving, toy_server
from tests.support.small_system import PATIENCE_S, SmallSystem, small_system
from tests.support.toy_server import RETRY_S, ROUND_S
from tests.support.toy_stages import DOORS

pytestmark = pytest.mark.timeout(600)


class HeldJobs:
    """Submits jobs of toy stages that wait in their fit, or at another point, until the test releases them."""

    def __init__(self, client: httpx.Client, folder: Path) -> None:
        self.client, self._folder, self._made = client, folder, 0

    def submit(self, hold: str | None = "fit-start", *, rig: bool = False, **options: Any) -> tuple[str, Path]:
        """Submit a job; returns its id and the folder of the files that steer its stages."""
        self._made += 1
        steering = self._folder / f"source-{self._made}" / "steering"
        steering.mkdir(parents=True)
        if hold is not None:
            (steering / f"hold-{hold}").touch()
        source = str(steering.parent)
        spec = {"workers": 2, **({"rig": {"mouth": source}} if rig else {"capture": source}), **options}
        answer = self.client.post("/v1/jobs", json=spec)
        assert answer.status_code == 201, answer.text
        return answer.json()["id"], steering

    def get(self, job: str) -> dict[str, Any]:
        return dict(self.client.get(f"/v1/jobs/{job}").json())

    def end(self, job: str) -> str:
        """Wait for the job's end; returns its state."""
        self.client.get(f"/v1/jobs/{job}/events", timeout=PATIENCE_S)
        return str(self.get(job)["state"])


def wait_until(condition: Callable[[], object], complaint: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, complaint
        time.sleep(0.02)


def release(steering: Path) -> None:
    for hold in steering.glob("hold-*"):
        hold.unlink()


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SmallSystem]:
    """A system with two workers for stages and one for captures."""
    with small_system(tmp_path_factory.mktemp("system"), has_rig_apart=True) as system:
        yield system


@pytest.fixture
def jobs(system: SmallSystem, tmp_path: Path) -> Iterator[HeldJobs]:
    with system.client() as client:
        yield HeldJobs(client, tmp_path)


@pytest.fixture(scope="module")
def own_workers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HeldJobs]:
    """A server with workers of its own."""
    folder = tmp_path_factory.mktemp("own")
    with toy_server(folder / "data") as (client, _):
        yield HeldJobs(client, folder)


def both_fit_and_a_capture_ends(jobs: HeldJobs) -> None:
    (first, first_steering), (second, second_steering) = jobs.submit(), jobs.submit()
    for steering in (first_steering, second_steering):
        wait_until((steering / "at-fit-start").exists, "the jobs do not fit side by side")
    captured, captured_steering = jobs.submit("capture-end", rig=True)
    wait_until((captured_steering / "at-capture-end").exists, "the capture waits for a fit")
    told = jobs.client.get("/v1/workers").json()["workers"]
    busy = {(worker["has_dome"], task["job"]) for worker in told for task in worker["tasks"]}
    assert busy == {(False, first), (False, second), (True, captured)}
    assert [jobs.get(job)["state"] for job in (first, second, captured)] == ["RUNNING"] * 3
    for steering in (first_steering, second_steering, captured_steering):
        release(steering)
    assert [jobs.end(job) for job in (first, second, captured)] == ["SUCCEEDED"] * 3


@pytest.mark.dear(
    "It is the first to ask for the system: a database, a scheduler, three workers and an API are started as processes."
)
def test_two_fits_and_a_capture_run_side_by_side(jobs: HeldJobs) -> None:
    both_fit_and_a_capture_ends(jobs)


@pytest.mark.dear("A server starts workers of its own, as processes that import the renderer.")
def test_a_server_with_workers_of_its_own_keeps_one_for_captures(own_workers: HeldJobs) -> None:
    both_fit_and_a_capture_ends(own_workers)


def test_a_cancel_that_stops_a_worker_leaves_the_other_jobs(own_workers: HeldJobs) -> None:
    jobs = own_workers
    (deaf, deaf_steering), (other, other_steering) = jobs.submit("fit-end"), jobs.submit()
    (deaf_steering / "deaf-fit").touch()
    for steering in (deaf_steering, other_steering):
        wait_until((steering / "at-fit-start").exists, "the jobs do not fit side by side")
    pid = (other_steering / "at-fit-start").read_text()
    jobs.client.post(f"/v1/jobs/{deaf}/cancel")
    assert jobs.end(deaf) == "CANCELLED"
    release(other_steering)
    assert jobs.end(other) == "SUCCEEDED"
    fit = next(stage for stage in jobs.get(other)["stages"] if stage["stage"] == "fit")
    assert (fit["attempt"], (other_steering / "at-fit-end").read_text()) == (1, pid)


@pytest.mark.dear("Six jobs go through a server, which tells of each why it waits.")
def test_what_a_queued_job_waits_for_is_told(
    system: SmallSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", ROUND_S)
    monkeypatch.setattr("services.api.jobs.admission.RETRY_S", RETRY_S)
    settings = ServerSettings(data=tmp_path / "data", jobs_at_once=1, scheduler=system.scheduler)
    with serving(create_app(settings, doors=DOORS)) as client:
        jobs = HeldJobs(client, tmp_path)
        running, steering = jobs.submit()
        wait_until((steering / "at-fit-start").exists, "the first job does not start")
        waiting, low, high = (jobs.submit(None, priority=priority)[0] for priority in ("normal", "low", "high"))
        time.sleep(1.0)
        for job in (waiting, low, high):
            told = jobs.get(job)
            assert (told["state"], told["waits_for"]) == (
                "QUEUED",
                "Waits for a place: job 1 runs, and 1 at once is the most.",
            )
        captured, captured_steering = jobs.submit("capture-end", rig=True, priority="low")
        second, _ = jobs.submit(None, rig=True, priority="low")
        wait_until((captured_steering / "at-capture-end").exists, "the capture waits for a place")
        wait_until(lambda: jobs.get(second)["waits_for"], "it is not told that the dome is busy")
        assert (
            jobs.get(second)["waits_for"]
            == f"Waits for the dome simulated: job {jobs.get(captured)['number']} captures with it."
        )
        release(captured_steering)
        wait_until(lambda: jobs.get(captured)["state"] == "QUEUED", "it goes on without a place")
        wait_until(
            lambda: "place" in (jobs.get(captured)["waits_for"] or ""), "it is not told that it waits for a place"
        )
        release(steering)
        ids = [running, waiting, low, high, captured, second]
        assert {jobs.end(job) for job in ids} == {"SUCCEEDED"}
        ended = sorted(ids, key=lambda job: float(jobs.get(job)["changed_s"]))
        assert ended[:4] == [running, high, waiting, low]


def test_a_job_waits_for_workers_that_can_run_its_stages(system: SmallSystem, jobs: HeldJobs) -> None:
    with system.without("worker", "worker2"):
        wait_until(
            lambda: jobs.client.get("/v1/health/ready").status_code == 503, "readiness does not miss the workers"
        )
        job, _ = jobs.submit(None)
        wait_until(lambda: jobs.get(job)["waits_for"], "it is not told what the job waits for")
        told = jobs.get(job)
        assert told["state"] == "QUEUED"
        assert told["waits_for"].startswith("Waits for workers: None of the 1 connected workers can run stages")
    assert jobs.end(job) == "SUCCEEDED"
