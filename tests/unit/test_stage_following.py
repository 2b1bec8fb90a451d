"""How a job follows a task that no worker runs, or whose worker dies with the result."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from services.core.errors import JobCancelledError
from services.core.records import JobSpec
from services.core.stage import StageName
from services.pipeline import stages
from services.pipeline.event_log import EventAddress
from services.pipeline.following import follow_stage
from services.pipeline.stage_task import StageTask

SPEC = JobSpec(capture=Path("/mouth"))


class Task:
    """A future of the scheduler: its statuses, one after the other, and how often its result does not arrive."""

    def __init__(self, *statuses: str, silent: int = 0) -> None:
        self._statuses, self._silent, self.asked = list(statuses), silent, 0

    @property
    def status(self) -> str:
        return self._statuses[0] if len(self._statuses) == 1 else self._statuses.pop(0)

    def result(self, timeout: float | None = None) -> None:
        assert timeout is not None, "the result is waited for without an end"
        self.asked += 1
        if self.asked <= self._silent:
            raise TimeoutError


def follow(monkeypatch: pytest.MonkeyPatch, folder: Path, task: Task, stage: StageName = "prepare") -> None:
    def wait(_futures: object, timeout: float) -> None:
        if task.status == "pending":
            raise TimeoutError

    monkeypatch.setattr("distributed.wait", wait)
    monkeypatch.setattr("services.pipeline.following.GRACE_S", 0.0)
    client: Any = SimpleNamespace(
        submit=lambda *_, **__: task, processing=dict, has_what=dict, restart_workers=lambda *_, **__: None
    )
    watch: Any = SimpleNamespace(pass_on_events=lambda: None)
    described = StageTask(stage, "door", SPEC, folder, EventAddress("sqlite://", "job"))
    follow_stage(client, lambda: None, described, watch)


def test_a_task_that_no_worker_takes_on_is_given_up_after_a_cancel(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stages.request_cancel(tmp_path)
    with pytest.raises(JobCancelledError):
        follow(monkeypatch, tmp_path, Task("pending"))


def test_a_capture_is_awaited_after_a_cancel(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stages.request_cancel(tmp_path)
    follow(monkeypatch, tmp_path, Task("pending", "pending", "pending", "finished"), "capture")


def test_a_result_that_dies_with_its_worker_is_waited_for_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    task = Task("finished", silent=2)
    follow(monkeypatch, tmp_path, task)
    assert task.asked == 3


def test_a_task_that_is_lost_is_followed_until_it_has_run_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # When a worker dies with a result, the task is lost: neither running nor ended.
    task = Task("lost", "lost", "lost", "finished")
    follow(monkeypatch, tmp_path, task)
    assert task.asked == 1


def test_a_task_that_has_ended_is_not_asked_again_when_its_result_is_lost_later(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    task = Task("finished", "finished", "lost")
    follow(monkeypatch, tmp_path, task)
    assert task.asked == 1
