"""When a job waits for disk, memory or workers, and which jobs are refused."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.api.jobs.admission import (
    DISK_PER_CAPTURE,
    KEPT_FREE_BYTES,
    MIN_DISK_BYTES,
    RETRY_S,
    WORKER_BYTES,
    Admission,
    Machine,
    predict,
)
from services.api.jobs.size import size_of
from services.client.errors import JobTooLargeError
from services.core.errors import DentineError, DiskFullError, ReadOnlyStoreError, SchedulerLostError
from services.core.records import JobSpec

GIB = 2**30


class World:
    """A machine and a clock that a test sets."""

    def __init__(self) -> None:
        self.machine, self.now_s = Machine(free_disk_bytes=50 * GIB, disk_bytes=100 * GIB, memory_bytes=16 * GIB), 0.0
        self.lacking: dict[bool, str] = {}
        """Why no worker can run a stage; keys: whether the stage is a capture."""
        self.admission = Admission(lambda: self.machine, lambda: self.now_s, missing_workers=self.lacking.get)

    def free(self, size: int) -> None:
        self.machine = Machine(size, self.machine.disk_bytes, self.machine.memory_bytes)


@pytest.fixture
def spec(tmp_path: Path) -> JobSpec:
    (tmp_path / "teeth").mkdir()
    (tmp_path / "teeth" / "a.npy").write_bytes(bytes(1 << 20))
    (tmp_path / "capture.json").touch()
    (tmp_path / "link").symlink_to("/proc/kcore")
    return JobSpec(capture=tmp_path, workers=2)


def test_the_prediction_counts_what_lies_on_the_disk(spec: JobSpec) -> None:
    needs = predict(spec)
    # Blocks of the file system round a file up by less than 64 KiB.
    assert 0 <= needs.disk_bytes - MIN_DISK_BYTES - DISK_PER_CAPTURE * 2**20 <= DISK_PER_CAPTURE * 2**16
    assert needs.memory_bytes == 2 * WORKER_BYTES


def test_a_folder_that_is_no_capture_is_not_walked_through(
    spec: JobSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "capture.json").unlink()
    monkeypatch.setattr(Path, "rglob", lambda *_: pytest.fail("it was walked through"))
    assert predict(spec).disk_bytes == MIN_DISK_BYTES


def test_a_mount_that_went_away_keeps_no_queue_from_moving(spec: JobSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = list(spec.capture.rglob("*")) if spec.capture else []

    def go_away(*_: object) -> Iterator[Path]:
        yield from whole
        raise OSError(errno.ESTALE, "Stale file handle")

    needed = predict(spec)
    monkeypatch.setattr(Path, "rglob", go_away)
    assert predict(spec) == needed
    assert not World().admission.holds("a", spec)


def test_what_cannot_even_be_looked_at_has_no_size(spec: JobSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr(Path, "stat", fail)
    assert size_of(spec) is None
    assert predict(spec).disk_bytes == MIN_DISK_BYTES


def test_a_job_waits_for_disk_and_starts_when_there_is_enough(spec: JobSpec) -> None:
    world, enough = World(), predict(spec).disk_bytes + KEPT_FREE_BYTES
    world.free(enough - 1)
    assert world.admission.holds("a", spec)
    assert "Waits for disk" in (world.admission.reason("a") or "")
    world.free(enough)
    assert not world.admission.holds("a", spec)
    assert world.admission.reason("a") is None


@pytest.mark.parametrize(
    ("problem", "what"),
    [
        (DiskFullError("Full; free some."), "disk"),
        (SchedulerLostError("Gone; start it."), "workers"),
        (ReadOnlyStoreError("Locked; open it."), "store"),
    ],
)
def test_what_was_paused_is_tried_again_after_a_while(spec: JobSpec, problem: DentineError, what: str) -> None:
    world = World()
    world.admission.pause("a", problem)
    assert world.admission.holds("a", spec)
    assert world.admission.reason("a") == f"Waits for {what}: {problem.message}"
    assert not world.admission.holds("b", spec)
    world.now_s = RETRY_S
    assert not world.admission.holds("a", spec)


def test_nothing_is_remembered_of_jobs_that_wait_no_more(spec: JobSpec) -> None:
    world = World()
    world.free(0)
    assert world.admission.holds("a", spec)
    assert world.admission.holds("b", spec)
    world.admission.begin_round(["b"])
    assert world.admission.reason("a") is None
    assert world.admission.reason("b")


def test_what_the_machine_never_has_is_refused_with_figures(spec: JobSpec) -> None:
    world = World()
    world.free(0)
    world.admission.refuse_too_large(spec)  # not refused: the job may wait
    with pytest.raises(
        JobTooLargeError, match=r"64 workers need about 96\.0 GiB of memory and there are 16\.0 GiB"
    ) as refusal:
        world.admission.refuse_too_large(spec.model_copy(update={"workers": 64}))
    assert refusal.value.evidence == {"needed_memory_bytes": 64 * WORKER_BYTES, "memory_bytes": 16 * GIB}
    world.machine = Machine(0, MIN_DISK_BYTES, 16 * GIB)
    with pytest.raises(JobTooLargeError, match=r"of disk and there are 0\.1 GiB in all"):
        world.admission.refuse_too_large(spec)


def test_a_running_job_whose_workers_went_away_says_so_until_one_comes(spec: JobSpec) -> None:
    world = World()
    world.admission.start("fit", 1, spec)
    world.admission.find_stalled()
    assert world.admission.stalled("fit") is None
    world.lacking[False] = "The scheduler has no workers; start some with dentine worker."
    world.admission.find_stalled()
    assert (
        world.admission.stalled("fit")
        == "Waits for workers: The scheduler has no workers; start some with dentine worker."
    )
    world.lacking.clear()
    world.admission.find_stalled()
    assert world.admission.stalled("fit") is None


def test_a_job_that_ended_waits_for_no_workers(spec: JobSpec) -> None:
    world = World()
    world.lacking[False] = "None."
    world.admission.start("fit", 1, spec)
    world.admission.find_stalled()
    world.admission.end("fit")
    assert world.admission.stalled("fit") is None
