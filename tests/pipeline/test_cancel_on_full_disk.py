"""A cancel on a full disk: one that cannot be recorded is not confirmed, and one that was recorded is carried out."""

from __future__ import annotations

import errno
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import sqlalchemy as sql

from services.api.app import create_app
from services.api.jobs.jobs import Jobs
from services.api.tables.lifecycle import JobState
from services.core.errors import JobCancelledError
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import CANCEL_FLAG, StageContext, StageEvent
from services.core.store import translate_disk_errors
from services.pipeline.event_log import folder_events
from services.pipeline.following import follow_stage
from services.pipeline.stage_task import StageTask
from services.pipeline.stages import request_cancel, withdraw_cancel
from tests.support.live_server import serving

PATIENCE_S = 30.0


class Held:
    """A ``run`` for a server's jobs that holds until it is released, and then ends as it is told to."""

    def __init__(self) -> None:
        self.begun, self.release = threading.Event(), threading.Event()
        self.end: Callable[[Path], None] = lambda _folder: None

    def __call__(self, _spec: JobSpec, folder: Path, _events: object) -> None:
        self.begun.set()
        assert self.release.wait(PATIENCE_S)
        self.end(folder)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Held:
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", 0.05)
    return Held()


@pytest.fixture
def jobs(tmp_path: Path, held: Held) -> Iterator[Jobs]:
    service = Jobs(ServerSettings(data=tmp_path / "data"), held)
    service.start()
    yield service
    held.release.set()
    service.close()


@contextmanager
def full_databases(*writes: str) -> Iterator[None]:
    """Let the databases take no write that begins so, by default none at all, as SQLite says it of a full disk."""

    def refuse(_connection: Any, _cursor: Any, statement: str, *_: object) -> None:
        if statement.startswith(writes or ("INSERT", "UPDATE", "DELETE")):
            refusal = sqlite3.OperationalError("database or disk is full")
            refusal.sqlite_errorname = "SQLITE_FULL"
            raise sql.exc.OperationalError(statement, None, refusal)

    sql.event.listen(sql.Engine, "before_cursor_execute", refuse)
    try:
        yield
    finally:
        sql.event.remove(sql.Engine, "before_cursor_execute", refuse)


def refuse_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk take no new file that is a cancel's flag."""
    touch = Path.touch

    def refuse(path: Path, *args: Any, **options: Any) -> None:
        if path.name == CANCEL_FLAG:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        touch(path, *args, **options)

    monkeypatch.setattr(Path, "touch", refuse)


def run_to_end(jobs: Jobs, job: str) -> JobState:
    pause = threading.Event()
    for _ in range(int(PATIENCE_S / 0.02)):
        if (state := jobs.repository.get(job).state).is_final:
            return state
        pause.wait(0.02)
    raise AssertionError(f"the job is {state}")


def test_a_job_that_ends_after_its_cancel_was_recorded_is_cancelled(jobs: Jobs, held: Held, tmp_path: Path) -> None:
    job = jobs.submit(JobSpec(capture=tmp_path)).job.id
    assert held.begun.wait(PATIENCE_S)
    assert jobs.cancel(job).state is JobState.CANCELLING
    held.release.set()
    assert run_to_end(jobs, job) is JobState.CANCELLED
    jobs.retry(job)
    assert run_to_end(jobs, job) is JobState.SUCCEEDED


def test_a_fit_whose_disk_is_full_is_cancelled_and_does_not_wait(jobs: Jobs, held: Held, tmp_path: Path) -> None:
    def end_on_full_disk(folder: Path) -> None:
        with translate_disk_errors(folder):
            raise OSError(errno.ENOSPC, "No space left on device", str(folder / "journal"))

    held.end = end_on_full_disk
    job = jobs.submit(JobSpec(capture=tmp_path)).job.id
    assert held.begun.wait(PATIENCE_S)
    jobs.cancel(job)
    held.release.set()
    assert run_to_end(jobs, job) is JobState.CANCELLED


def test_a_full_disk_still_takes_the_flag_of_a_cancel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    withdraw_cancel(tmp_path)
    refuse_flags(monkeypatch)
    request_cancel(tmp_path)
    assert (tmp_path / CANCEL_FLAG).exists()
    withdraw_cancel(tmp_path)
    assert not (tmp_path / CANCEL_FLAG).exists()


def test_a_cancel_without_a_flag_is_carried_out_and_waits_for_disk(
    jobs: Jobs, held: Held, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = jobs.submit(JobSpec(capture=tmp_path)).job.id
    assert held.begun.wait(PATIENCE_S)
    (jobs.folder(job) / ".cancel").unlink()
    with monkeypatch.context() as full:
        refuse_flags(full)
        cancelling = jobs.cancel(job)
        assert cancelling.state is JobState.CANCELLING
        assert (jobs.waits_for(cancelling) or "").startswith("Waits for disk: ")
        assert jobs.is_cancelled(job)
        assert not (jobs.folder(job) / CANCEL_FLAG).exists()
    assert jobs.is_cancelled(job), "it is to stop, and is told so by a file as soon as there is room"
    assert (jobs.folder(job) / CANCEL_FLAG).exists()
    assert jobs.waits_for(cancelling) is None


def test_a_stage_is_stopped_where_the_cancel_has_no_flag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never_ends(_futures: object, timeout: float) -> None:
        raise TimeoutError

    monkeypatch.setattr("distributed.wait", never_ends)
    monkeypatch.setattr("services.pipeline.following.GRACE_S", 0.0)
    pending = SimpleNamespace(status="pending")
    client: Any = SimpleNamespace(submit=lambda *_, **__: pending, processing=dict, has_what=dict)
    task = StageTask("fit", "door", JobSpec(capture=tmp_path), tmp_path, folder_events(tmp_path))
    watch: Any = SimpleNamespace(pass_on_events=lambda: None)
    with pytest.raises(JobCancelledError):
        follow_stage(client, lambda: None, task, watch, lambda: True)


def test_a_cancel_that_the_full_database_does_not_take_is_refused(tmp_path: Path, held: Held) -> None:
    with serving(create_app(ServerSettings(data=tmp_path / "data"), held)) as client:
        job = client.post("/v1/jobs", json={"capture": str(tmp_path)}).json()["id"]
        assert held.begun.wait(PATIENCE_S)
        with full_databases():
            assert client.post(f"/v1/jobs/{job}/cancel").status_code == 503, "the audit log cannot be written either"
        with full_databases("UPDATE job"):
            refused = client.post(f"/v1/jobs/{job}/cancel")
        assert (refused.status_code, refused.json()["code"]) == (507, "disk-full"), refused.text
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "RUNNING"
        assert client.post(f"/v1/jobs/{job}/cancel").json()["state"] == "CANCELLING"
        held.release.set()
        client.get(f"/v1/jobs/{job}/events")
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "CANCELLED"


def test_the_end_of_a_cancelled_job_waits_for_the_databases_disk(jobs: Jobs, held: Held, tmp_path: Path) -> None:
    job = jobs.submit(JobSpec(capture=tmp_path)).job.id
    assert held.begun.wait(PATIENCE_S)
    cancelling = jobs.cancel(job)
    with full_databases():
        held.release.set()
        pause = threading.Event()
        while jobs.waits_for(cancelling) is None:
            assert not pause.wait(0.02)
        assert (jobs.waits_for(cancelling) or "").startswith("Waits for disk: ")
        assert jobs.repository.get(job).state is JobState.CANCELLING
    assert run_to_end(jobs, job) is JobState.CANCELLED


def report_until_cancelled(_spec: JobSpec, context: StageContext) -> None:
    context.report(StageEvent(stage="fit", kind="step", message="A step.", done=0.5))


def test_a_stage_whose_events_find_no_disk_ends_with_a_cancel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = sql.exc.OperationalError("INSERT", None, OSError("database or disk is full"))

    def refuse(*_: object) -> None:
        request_cancel(tmp_path)
        raise full

    monkeypatch.setattr("services.pipeline.event_log.EventLog.append", refuse)
    task = StageTask(
        "fit", f"{__name__}:report_until_cancelled", JobSpec(capture=tmp_path), tmp_path, folder_events(tmp_path)
    )
    with pytest.raises(JobCancelledError):
        task()
