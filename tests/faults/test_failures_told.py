"""Failures, a cancel and a lack of disk space on a live server: the API states the cause of each, the measured evidence
and the next step.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.core.errors import JobCancelledError
from services.core.settings import ServerSettings
from tests.benchmarks.cancel_in_kernel import POLL_S, await_end, cancel_once, submit, worker_of_next
from tests.support.engine_server import MEMORY_BYTES, MIB, engine_server
from tests.support.live_server import serving, toy_server
from tests.support.store_disk import store_disk

pytestmark = pytest.mark.timeout(900)
LONGEST_CANCEL_S = 5.0
GIB = 2**30


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def client(data: Path) -> Iterator[httpx.Client]:
    with engine_server(data) as (client, _):
        yield client


def failure_of(client: httpx.Client, capture: Path, call: str) -> dict[str, Any]:
    told = await_end(client, submit(client, capture, call))
    assert told["state"] == "FAILED"
    assert told["failure"]["stage"] == "fit"
    return dict(told["failure"])


@pytest.mark.dear("A worker grows until it is killed, again and again.")
def test_a_memory_kill(client: httpx.Client, tmp_path: Path) -> None:
    failure = failure_of(client, tmp_path, "grow")
    assert failure["code"] == "memory-killed"
    assert failure["message"].endswith("lower samples_per_pixel, raise pixel_step or give the worker more memory.")
    limit = failure["evidence"]["memory_limit_bytes"]
    assert limit <= MEMORY_BYTES
    assert limit < failure["evidence"]["peak_memory_bytes"]


def test_a_crash_by_a_signal(client: httpx.Client, tmp_path: Path) -> None:
    failure = failure_of(client, tmp_path, "crash")
    assert failure["code"] == "process-crashed"
    assert "ended by SIGSEGV twice in one task; look for its last words in the worker's log." in failure["message"]
    assert failure["evidence"]["exit_status"] == -signal.SIGSEGV


@pytest.mark.dear("A worker is killed until its task is given up.")
def test_a_lost_worker(client: httpx.Client, tmp_path: Path) -> None:
    failure = failure_of(client, tmp_path, "lose")
    assert failure["code"] == "worker-lost"
    assert failure["message"].endswith("free some memory or set fewer workers, then run again.")
    assert failure["evidence"] == {"stage": "fit", "deaths": 4}


def test_bad_input(client: httpx.Client, tmp_path: Path) -> None:
    failure = failure_of(client, tmp_path, "read")
    assert (failure["code"], failure["exit_status"]) == ("bad-capture", 2)
    assert failure["message"] == f"{tmp_path / 'capture.json'} does not exist; check the path."


def held_after_preparation(client: httpx.Client, tmp_path: Path) -> tuple[Path, str]:
    """Submit a job whose preparation gets published and whose fit waits while ``hold-prepare-end`` exists; returns the
    folder of that file and the job's id.
    """
    steering = tmp_path / "steering"
    steering.mkdir()
    (steering / "hold-prepare-end").touch()
    job = submit(client, tmp_path, "none")
    while not (steering / "at-prepare-end").exists():
        time.sleep(0.02)
    return steering, job


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (
            lambda shard: shard.write_text("9\n"),
            "by.txt of published stage prepared differs from its published checksum",
        ),
        (
            lambda shard: os.truncate(shard, 1),
            "by.txt of published stage prepared has 1 bytes instead of 2 (truncated?)",
        ),
        (Path.unlink, "by.txt is missing from published stage prepared"),
        (
            lambda shard: os.truncate(shard.with_name("manifest.json"), 40),
            "manifest.json, the list of what stage prepared published, cannot be read",
        ),
    ],
    ids=["altered", "truncated", "removed", "its list truncated"],
)
def test_a_shard_damaged_between_two_stages(
    client: httpx.Client, data: Path, tmp_path: Path, damage: Callable[[Path], object], told: str
) -> None:
    steering, job = held_after_preparation(client, tmp_path)
    folder = data / "jobs" / job
    damage(folder / "prepared" / "by.txt")
    (steering / "hold-prepare-end").unlink()

    ended = await_end(client, job)
    assert (ended["state"], ended["failure"]["code"], ended["failure"]["stage"]) == ("FAILED", "store-corrupt", "fit")
    assert (
        ended["failure"]["message"]
        == f"{folder}/prepared/{told}; restore it, or retry the job, which then makes prepared anew."
    )
    assert (steering / "publications.txt").read_text().split() == ["prepare"]

    client.post(f"/v1/jobs/{job}/retry").raise_for_status()
    assert await_end(client, job)["state"] == "SUCCEEDED"
    assert (steering / "publications.txt").read_text().split() == ["prepare", "prepare", "fit", "export"]
    assert client.get(f"/v1/jobs/{job}/artifacts/report.html").status_code == 200


def test_a_damaged_shard_that_is_restored_costs_no_preparation(
    client: httpx.Client, data: Path, tmp_path: Path
) -> None:
    steering, job = held_after_preparation(client, tmp_path)
    shard = data / "jobs" / job / "prepared" / "by.txt"
    good = shard.read_bytes()
    shard.unlink()
    (steering / "hold-prepare-end").unlink()
    assert await_end(client, job)["failure"]["code"] == "store-corrupt"

    shard.write_bytes(good)
    client.post(f"/v1/jobs/{job}/retry").raise_for_status()
    assert await_end(client, job)["state"] == "SUCCEEDED"
    assert (steering / "publications.txt").read_text().split() == ["prepare", "fit", "export"]


def test_a_cancel_in_mid_kernel_of_the_real_engine_leaves_the_worker_the_same_process(
    client: httpx.Client, tmp_path: Path
) -> None:
    before = worker_of_next(client, tmp_path / "before")
    cancelled = cancel_once(client, tmp_path / "cancelled")
    assert cancelled.seconds < LONGEST_CANCEL_S
    assert (cancelled.worker, worker_of_next(client, tmp_path / "after")) == (before, before)


def test_tasks_cancelled_by_nobody_here_hold_the_job_back_instead_of_starting_it_over_and_over(tmp_path: Path) -> None:
    attempts = []

    def run(*_: object) -> None:
        attempts.append(True)
        raise JobCancelledError("Cancelled in Dask.")

    (tmp_path / "capture").mkdir()
    with serving(create_app(ServerSettings(data=tmp_path / "data"), run)) as client:
        job = client.post("/v1/jobs", json={"capture": str(tmp_path / "capture")}).json()["id"]
        while (told := client.get(f"/v1/jobs/{job}").json())["waits_for"] is None:
            assert len(attempts) <= 1
        assert (told["state"], told["waits_for"]) == (
            "QUEUED",
            (
                "Waits for workers: The workers dropped the job's tasks, which nobody had asked for here; it goes on by"
                " itself."
            ),
        )
        assert len(attempts) == 1


def test_a_want_of_disk_refuses_what_never_fits_and_loses_nothing_of_what_will(tmp_path: Path) -> None:
    # The server's SQLite database is on the same disk.
    steering = tmp_path / "teeth" / "steering"
    steering.mkdir(parents=True)
    (steering / "hold-fit-middle").touch()
    with store_disk(tmp_path / "data", 4 * GIB) as disk, toy_server(disk.folder) as (client, _):
        refused = client.post("/v1/jobs", json={"workers": 1, "rig": {"mouth": str(tmp_path)}})
        assert (refused.status_code, refused.json()["code"]) == (507, "job-too-large")
        assert refused.json()["detail"].startswith("The job needs about 12.1 GiB of disk and there are 3.")

        with disk.almost_full(128 * MIB):
            job = submit(client, tmp_path / "teeth", "answer")
            while (told := client.get(f"/v1/jobs/{job}").json())["waits_for"] is None:
                pass
            assert (told["state"], told["waits_for"]) == (
                "QUEUED",
                "Waits for disk: about 0.3 GiB are needed and 0.1 GiB are free.",
            )
            assert bad_parts(client) == {"disk"}

        while not (steering / "at-fit-middle").exists():
            time.sleep(POLL_S)
        with disk.full():
            (steering / "hold-fit-middle").unlink()
            while "store" not in (bad := bad_parts(client)):
                pass
            assert "disk" in bad
        assert await_end(client, job)["state"] == "SUCCEEDED"
        assert (steering / "publications.txt").read_text().split() == ["prepare", "fit", "export"]


def bad_parts(client: httpx.Client) -> set[str]:
    """Names of the parts that the readiness route names as bad."""
    return {check["name"] for check in client.get("/v1/health/ready").json()["checks"] if not check["ok"]}
