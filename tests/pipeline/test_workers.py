"""A server lists its workers and their tasks, and states that it cannot when the scheduler does not answer."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client as Dask
from distributed import LocalCluster

from services.api.app import create_app
from services.client.client import Client
from services.core.errors import SchedulerLostError
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.pipeline.event_log import EventAddress
from services.pipeline.workers import Workers, _freeze_loaded_objects_once
from tests.support.live_server import serving
from tests.support.uploading import write_capture


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    # The worker runs in the tests' own process, which may use more memory than the stated limit, so the limit is not
    # enforced.
    unlimited = dict.fromkeys(
        (f"distributed.worker.memory.{act}" for act in ("target", "spill", "pause", "terminate")), False
    )
    options = {
        "n_workers": 1,
        "threads_per_worker": 1,
        "processes": False,
        "protocol": "tcp",
        "dashboard_address": "127.0.0.1:0",
        "memory_limit": "1 GiB",
    }
    # Settings that every connection of a server changes for its process.
    as_if_alone: dict[str, Any] = {**unlimited, "distributed.worker.preload": []}
    with dask.config.set(as_if_alone), LocalCluster(**options, resources={"DOME": 1}) as cluster:
        yield cluster


def wait_for(path: Path) -> None:
    while not path.exists():
        time.sleep(0.01)


def test_workers_tell_what_they_do(tmp_path: Path, cluster: LocalCluster) -> None:
    go_on = tmp_path / "go-on"

    def run(_spec: JobSpec, _folder: Path, events: EventAddress) -> None:
        with Dask(cluster) as dask:
            dask.submit(wait_for, go_on, key=f"fit-{events.job}-0123abcd").result()

    settings = ServerSettings(data=tmp_path / "data", scheduler=cluster.scheduler_address)
    with serving(create_app(settings, run)) as http, Client(str(http.base_url)) as client:
        assert (client.workers()["sentence"], client.workers()["succeeded_last_day"]) == ("1 worker, 0 busy.", 0)
        job = client.submit(JobSpec(capture=write_capture(tmp_path / "capture")))["id"]
        while not (told := client.workers())["workers"][0]["tasks"]:
            assert client.get(job)["state"] in {"QUEUED", "RUNNING"}
        worker = told["workers"][0]
        assert (told["sentence"], worker["tasks"]) == ("1 worker, 1 busy.", [{"stage": "fit", "job": job}])
        assert (worker["threads"], worker["memory_limit_bytes"], worker["has_dome"]) == (1, 2**30, True)
        assert worker["memory_bytes"] > 2**20
        go_on.touch()
        assert [event.data.get("state") for event in client.events(job)][-1] == "SUCCEEDED"
        assert (client.workers()["succeeded_last_hour"], client.workers()["succeeded_last_day"]) == (1, 1)
        cluster.close()
        with pytest.raises(SchedulerLostError, match="does not answer"):
            client.workers()
        assert http.get("/v1/workers").status_code == 503


def test_a_scheduler_that_does_not_answer_leaves_nothing_behind_that_is_never_collected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("services.pipeline.workers.CONNECT_S", 0.1)
    # Another test of this process may have been the first to connect, and a later one may have thawed what it froze.
    _freeze_loaded_objects_once.cache_clear()
    workers, frozen = Workers("tcp://127.0.0.1:1"), []
    for _ in range(3):
        with pytest.raises(SchedulerLostError):
            workers.connect()
        frozen.append(gc.get_freeze_count())
    assert frozen[0] > 0
    assert frozen == sorted(frozen, reverse=True)


def test_workers_that_were_not_started_are_not_told_of(tmp_path: Path) -> None:
    with (
        serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as http,
        Client(str(http.base_url)) as client,
    ):
        assert client.workers() == {
            "workers": [],
            "sentence": "Workers start with the next job.",
            "succeeded_last_hour": 0,
            "succeeded_last_day": 0,
        }
