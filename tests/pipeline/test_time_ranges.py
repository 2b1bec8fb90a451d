"""A server states time ranges for its jobs after it has run some, and otherwise the reason why it cannot."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.api.jobs.forecast import MIN_OBSERVATIONS
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageEvent, StageName
from services.pipeline.event_log import EventAddress
from services.pipeline.machine_class import machine_class
from tests.support.live_server import serving
from tests.support.past_runs import remember_runs
from tests.support.uploading import write_capture

STAGES: tuple[StageName, ...] = ("prepare", "fit", "export")


class HeldJob:
    """A job that runs its stages at once, or waits in the middle of the fit until ``goes_on`` is set."""

    def __init__(self) -> None:
        self.goes_on, self.is_in_fit = threading.Event(), threading.Event()
        self.goes_on.set()

    def __call__(self, _spec: JobSpec, _folder: Path, events: EventAddress) -> None:
        with events.open() as log:
            for stage in STAGES:
                attempt = log.begin_stage(stage, machine=machine_class())
                if stage == "fit":
                    log.append(attempt, StageEvent(stage=stage, kind="step", done=0.5))
                    self.is_in_fit.set()
                    self.goes_on.wait()
                log.append(attempt, StageEvent(stage=stage, kind="finished", done=1.0))


@pytest.fixture
def held() -> HeldJob:
    return HeldJob()


@pytest.fixture
def server(tmp_path: Path, held: HeldJob) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path / "data", jobs_at_once=1), held)) as client:
        yield client
        held.goes_on.set()


@pytest.fixture
def capture(tmp_path: Path) -> str:
    return str(write_capture(tmp_path / "mine"))


def submit(client: httpx.Client, capture: str, **options: Any) -> str:
    answer = client.post("/v1/jobs", json={"capture": capture} | options)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def ended(client: httpx.Client, job: str) -> dict[str, Any]:
    client.get(f"/v1/jobs/{job}/events")
    return dict(client.get(f"/v1/jobs/{job}").json())


def submit_held(client: httpx.Client, held: HeldJob, capture: str, **options: Any) -> str:
    held.goes_on.clear()
    held.is_in_fit.clear()
    job = submit(client, capture, **options)
    assert held.is_in_fit.wait(60)
    return job


def test_jobs_that_succeed_are_counted_until_they_suffice(server: httpx.Client, held: HeldJob, capture: str) -> None:
    for seed in range(MIN_OBSERVATIONS):
        running = submit_held(server, held, capture, seed=seed)
        told = server.get(f"/v1/jobs/{running}").json()["remaining"]
        assert (told["low_s"], told["high_s"], told["past_jobs"]) == (None, None, seed)
        assert f"{MIN_OBSERVATIONS} are needed" in told["reason"]
        held.goes_on.set()
        assert ended(server, running)["remaining"] is None
    unlike = submit_held(server, held, capture, stains=True)
    assert server.get(f"/v1/jobs/{unlike}").json()["remaining"]["past_jobs"] == 0


def test_a_queued_job_waits_for_those_before_it(
    server: httpx.Client, held: HeldJob, capture: str, tmp_path: Path
) -> None:
    remember_runs(tmp_path / "data", capture, (900.0, 950.0, 1000.0, 1050.0, 1100.0))
    running = submit_held(server, held, capture)
    queued, last = submit(server, capture), submit(server, capture)
    own, first, second = (server.get(f"/v1/jobs/{job}").json()["remaining"] for job in (running, queued, last))
    assert own["past_jobs"] == first["past_jobs"] == second["past_jobs"] == 5, (own, first, second)
    for told, truth_s in ((own, 1000.0), (first, 2000.0), (second, 3000.0)):
        assert told["low_s"] < truth_s < told["high_s"] < 2 * truth_s


def test_a_job_behind_one_without_a_range_has_none(
    server: httpx.Client, held: HeldJob, capture: str, tmp_path: Path
) -> None:
    remember_runs(tmp_path / "data", capture, (900.0, 950.0, 1000.0, 1050.0, 1100.0))
    submit_held(server, held, capture, stains=True)
    queued = submit(server, capture)
    told = server.get(f"/v1/jobs/{queued}").json()["remaining"]
    assert told["low_s"] is None
    assert told["reason"].startswith("Job 1 comes first: 0 jobs like this one")


def test_what_is_learned_from_a_job_goes_with_it(server: httpx.Client, held: HeldJob, capture: str) -> None:
    first = submit(server, capture)
    assert ended(server, first)["state"] == "SUCCEEDED"
    running = submit_held(server, held, capture)
    assert server.get(f"/v1/jobs/{running}").json()["remaining"]["past_jobs"] == 1
    assert server.delete(f"/v1/jobs/{first}").status_code == 200
    assert server.get(f"/v1/jobs/{running}").json()["remaining"]["past_jobs"] == 0


def test_a_capture_of_unknown_size_has_no_range(server: httpx.Client, held: HeldJob, tmp_path: Path) -> None:
    running = submit_held(server, held, str(tmp_path))
    queued = submit(server, str(tmp_path))
    told = server.get(f"/v1/jobs/{running}").json()
    assert "size of its capture cannot be read" in told["remaining"]["reason"]
    assert server.get(f"/v1/jobs/{queued}").json()["remaining"]["low_s"] is None
    held.goes_on.set()
    assert ended(server, queued)["remaining"] is None


def test_watch_says_when_the_job_ends(server: httpx.Client, held: HeldJob, capture: str, tmp_path: Path) -> None:
    remember_runs(tmp_path / "data", capture, (900.0, 950.0, 1000.0, 1050.0, 1100.0))
    running = submit_held(server, held, capture)
    command = [sys.executable, "-m", "services", "watch", running, "--server", str(server.base_url)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as watching:
        assert watching.stderr is not None
        said = next(line for line in watching.stderr if line.startswith("job: ends"))
        held.goes_on.set()
        assert watching.wait(60) == 0
    assert re.fullmatch(r"job: ends in 1\d to \d\d min \(80 % range from 5 past jobs\)\n", said)
