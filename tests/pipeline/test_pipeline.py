"""Guarantees of the pipeline for any stages: order, resume, retry, cancel, and a single owner."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services.core.errors import (
    CaptureInputError,
    FencedError,
    InputError,
    JobCancelledError,
    PlatformError,
    WorkerLostError,
)
from services.core.events import JobEvent
from services.core.records import JobSpec, RigSpec
from services.core.stage import StageEvent
from services.core.store import is_published
from services.pipeline.event_log import folder_events
from services.pipeline.stage_task import StageTask
from services.pipeline.stages import request_cancel, run_job, stages_of, withdraw_cancel
from services.pipeline.workers import Workers
from tests.support.toy_stages import DOORS

RIG = JobSpec(rig=RigSpec(mouth=Path("/mouth")), workers=1)
FOLDER = JobSpec(capture=Path("/capture"), workers=1)


@pytest.fixture(scope="module")
def workers() -> Iterator[Workers]:
    """Workers that all tests share, as a server's jobs do."""
    with Workers() as workers:
        yield workers


def run(
    workers: Workers, spec: JobSpec, root: Path, on_event: Callable[[JobEvent], None] | None = None
) -> list[JobEvent]:
    seen: list[JobEvent] = []

    def listen(event: JobEvent) -> None:
        seen.append(event)
        if on_event is not None:
            on_event(event)

    run_job(spec, root, listen, doors=DOORS, cluster=workers)
    return seen


def ran(events: list[JobEvent]) -> list[tuple[str | None, int]]:
    return [(event.stage, event.attempt) for event in events if event.kind == "started"]


def test_stages_run_in_order_and_a_repeat_runs_nothing(workers: Workers, tmp_path: Path) -> None:
    assert ran(run(workers, RIG, tmp_path)) == [("capture", 1), ("prepare", 1), ("fit", 1), ("export", 1)]
    assert run(workers, RIG, tmp_path) == []


def test_a_folder_capture_needs_no_capture_stage() -> None:
    assert stages_of(FOLDER) == ("prepare", "fit", "export")


def test_bad_input_arrives_as_its_own_error_and_the_job_resumes_after_it(workers: Workers, tmp_path: Path) -> None:
    (tmp_path / "bad-input").touch()
    with pytest.raises(CaptureInputError, match=r"c0_l3\.npy is missing"):
        run(workers, RIG, tmp_path)
    assert is_published(tmp_path, "capture")
    (tmp_path / "bad-input").unlink()
    assert ran(run(workers, RIG, tmp_path)) == [("prepare", 2), ("fit", 1), ("export", 1)]


def test_a_killed_worker_costs_an_attempt_not_the_job(workers: Workers, tmp_path: Path) -> None:
    (tmp_path / "kill-fit").touch()
    events = run(workers, FOLDER, tmp_path)
    assert ran(events) == [("prepare", 1), ("fit", 1), ("fit", 2), ("export", 1)]
    assert (tmp_path / "fit" / "by.txt").read_text() == "2\n"


def test_a_stage_that_always_kills_ends_in_a_sentence(workers: Workers, tmp_path: Path) -> None:
    (tmp_path / "always-kill").touch()
    with pytest.raises(WorkerLostError, match="stage fit died 4 times"):
        run(workers, FOLDER, tmp_path)
    assert not is_published(tmp_path, "fit")


def test_a_package_that_a_worker_lacks_is_named(tmp_path: Path) -> None:
    task = StageTask("capture", "tests.support.toy_stages:needy", RIG, tmp_path, folder_events(tmp_path))
    with pytest.raises(
        PlatformError, match=r"needs no_such_package, which its workers do not have; install dentine\[capture\]"
    ):
        task()


def test_cancel_waits_until_the_dome_is_dark(workers: Workers, tmp_path: Path) -> None:
    (tmp_path / "hold-capture").touch()
    with pytest.raises(JobCancelledError):
        run(workers, RIG, tmp_path, lambda _: request_cancel(tmp_path))
    assert not (tmp_path / "lit").exists()
    assert not is_published(tmp_path, "capture")


def test_cancel_frees_workers_that_do_not_listen(
    workers: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.pipeline.following.GRACE_S", 0.5)
    (tmp_path / "deaf-fit").touch()
    # The workers end with this run, because they would begin the deaf stage anew once it can be heard again.
    with Workers() as its_own, pytest.raises(JobCancelledError):
        run(its_own, FOLDER, tmp_path, lambda event: request_cancel(tmp_path) if event.stage == "fit" else None)
    (tmp_path / "deaf-fit").unlink()
    withdraw_cancel(tmp_path)
    assert ran(run(workers, FOLDER, tmp_path)) == [("fit", 2), ("export", 1)]


def test_a_folder_belongs_to_one_run_and_one_set_of_options(workers: Workers, tmp_path: Path) -> None:
    (tmp_path / "hold-capture").touch()
    started = threading.Event()
    first = threading.Thread(target=run, args=(workers, RIG, tmp_path, lambda _: started.set()))
    first.start()
    try:
        assert started.wait(60)
        with pytest.raises(InputError, match="in use"):
            run(workers, RIG, tmp_path)
    finally:
        (tmp_path / "hold-capture").unlink()
        first.join()
    with pytest.raises(InputError, match=r"other options \(seed\)"):
        run(workers, RIG.model_copy(update={"seed": 2}), tmp_path)
    assert run(workers, RIG.model_copy(update={"workers": 2}), tmp_path) == []


def test_an_overtaken_attempt_cannot_report(tmp_path: Path) -> None:
    with folder_events(tmp_path, "job").open() as log:
        old = log.begin_stage("fit")
        assert log.begin_stage("fit") == old + 1
        with pytest.raises(FencedError):
            log.append(old, StageEvent(stage="fit", kind="log"))
        assert log.begin_stage("fit", known=7) == 8


def test_writers_at_once_lose_no_event(tmp_path: Path) -> None:
    address = folder_events(tmp_path, "job")

    def write() -> None:
        with address.open() as log:
            attempts.extend(log.begin_stage("fit") for _ in range(25))

    attempts: list[int] = []
    with address.open() as log:
        threads = [threading.Thread(target=write) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(attempts) == list(range(1, 101))
        assert len(log.read()) == 100
        assert [event.id for event in log.read(after=90)] == list(range(91, 101))
        assert all(event.time_s <= time.time() for event in log.read())
