"""A cancel ends the tasks of its own job; tasks of another job on the same worker go on, and are not begun again."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from distributed import Client, LocalCluster

from services.core.errors import JobCancelledError
from services.core.files.content_files import StoredFile
from services.core.placement import STAGES, UNLIMITED
from services.core.records import JobSpec
from services.core.stage import CANCEL_FLAG, StageContext
from services.pipeline.event_log import EventAddress, folder_events
from services.pipeline.following import follow_stage
from services.pipeline.stage_task import StageTask
from services.tasks.engine_host import ChildHost
from services.tasks.executors import DaskExecutor
from tests.support.small_system import PATIENCE_S

ENGINE = "tests.support.fake_engine:FakeEngine"


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """A connection to one worker with two threads, on which two jobs run at once."""
    with (
        LocalCluster(
            n_workers=1,
            threads_per_worker=2,
            processes=True,
            dashboard_address="127.0.0.1:0",
            resources={STAGES: UNLIMITED},
            silence_logs=50,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def hold(_spec: JobSpec, context: StageContext) -> None:
    """Run until the file ``release`` exists, whatever is cancelled meanwhile."""
    with (context.root / "begun").open("a") as stream:
        stream.write(f"{os.getpid()}\n")
    wait_until((context.root / "release").exists)


def wait_until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "it does not happen"
        time.sleep(0.01)


def start(pool: ThreadPoolExecutor, client: Client, folder: Path, job: str) -> tuple[Future[None], Path]:
    """Follow a stage that holds, in a thread; returns once the stage runs."""
    (root := folder / job).mkdir()
    task = StageTask(
        "fit", f"{__name__}:hold", JobSpec(capture=folder), root, EventAddress(folder_events(root).url, job)
    )
    watch: Any = SimpleNamespace(pass_on_events=lambda: None)
    followed = pool.submit(follow_stage, client, lambda: None, task, watch)
    wait_until((root / "begun").exists)
    return followed, root


def test_a_cancel_ends_its_own_stage_and_not_that_of_another_job_on_its_worker(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.pipeline.following.GRACE_S", 0.2)
    with ThreadPoolExecutor(2) as pool:
        (cancelled, root), (other, other_root) = (start(pool, client, tmp_path, job) for job in ("first", "second"))
        try:
            (root / CANCEL_FLAG).touch()
            with pytest.raises(JobCancelledError):
                cancelled.result(PATIENCE_S)
            assert not other.done()
        finally:
            (other_root / "release").touch()
        other.result(PATIENCE_S)
    assert (other_root / "begun").read_text() == (root / "begun").read_text(), "the other stage was begun again"
    with folder_events(other_root, "second").open() as log:
        assert {event.attempt for event in log.read()} == {1}


def linger(_host: object, told: str) -> None:
    Path(told).touch()
    wait_until(Path(told).with_suffix(".release").exists)


def test_a_cancelled_fit_does_not_wait_for_the_tasks_before_its_own(client: Client, tmp_path: Path) -> None:
    flag, others = tmp_path / "cancel", [tmp_path / "other-1", tmp_path / "other-2"]
    other, cancelled = (
        DaskExecutor(client, ENGINE, name, tmp_path / file)
        for name, file in (("other", "no"), ("cancelled", flag.name))
    )
    with ThreadPoolExecutor(2) as pool:
        long = pool.submit(other.gather, [other.submit("linger", linger, str(one)) for one in others])
        wait_until(lambda: all(one.exists() for one in others))
        waiting = pool.submit(cancelled.gather, [cancelled.submit("linger", linger, str(tmp_path / "never"))])
        flag.touch()
        try:
            with pytest.raises(JobCancelledError):
                waiting.result(PATIENCE_S / 2)
            assert not long.done()
        finally:
            for one in others:
                one.with_suffix(".release").touch()
        long.result(PATIENCE_S)
    assert not (tmp_path / "never").exists(), "a task of the cancelled fit began"


def test_a_cancelled_job_does_not_wait_for_its_running_tasks(client: Client, tmp_path: Path) -> None:
    begun, flag = tmp_path / "block", tmp_path / "cancel"
    run_on = DaskExecutor(client, ENGINE, "running", flag)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(list, run_on.as_completed([("linger", linger, (str(begun),))]))
        wait_until(begun.exists)
        flag.touch()
        try:
            with pytest.raises(JobCancelledError):
                waiting.result(PATIENCE_S / 2)
        finally:
            begun.with_suffix(".release").touch()


def refuse(_host: object, first: str) -> None:
    wait_until(Path(first).exists)
    raise ValueError("It cannot be read.")


def test_after_an_exception_no_task_begins_that_has_not_begun(client: Client, tmp_path: Path) -> None:
    names = [tmp_path / f"task-{k}" for k in range(8)]
    run_on = DaskExecutor(client, ENGINE, "refused", tmp_path / "no")
    calls = [("refuse", refuse, (str(names[0]),)), *((one.name, linger, (str(one),)) for one in names)]
    with pytest.raises(ValueError, match="cannot be read"):
        list(run_on.as_completed(calls))
    for one in names:
        one.with_suffix(".release").touch()
    # The worker has two threads. A task that is sent now begins after those that were under way.
    assert run_on.gather([run_on.submit("last", lambda _host: 1)]) == [1]
    assert not any(one.exists() for one in names[3:])


def test_a_cancelled_call_leaves_the_kernel_that_it_waits_for(tmp_path: Path) -> None:
    host, recipe, cancelled = ChildHost(ENGINE), StoredFile(tmp_path / "recipe", "digest"), threading.Event()
    cancelled.set()
    with host._lock, pytest.raises(JobCancelledError):  # another job's call has the child
        host.call_until(cancelled.is_set, "answer", recipe)
