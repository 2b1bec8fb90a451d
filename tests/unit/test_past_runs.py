"""What is learned from the events of earlier jobs, and which of them a running job is compared with."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sql

from services.api.jobs.past_runs import Course, PastRun, course_of, tenth_of
from services.api.jobs.repository import Repository
from services.api.jobs.size import JobSize, method_of, size_of
from services.api.jobs.time_ranges import Position, TimeRange, TimeRanges, time_range
from services.core.events import JobEvent
from services.core.records import JobSpec, RigSpec
from services.core.settings import DATABASE_FILE
from services.core.stage import StageEvent
from services.pipeline.database import sqlite_url
from services.pipeline.machine_class import machine_class
from tests.support.past_runs import remember_runs
from tests.support.uploading import write_capture

SIZE = JobSize(pixels=1000, samples=64, steps=12)
CLASS = "Some processor, 2 cores, 8 GiB"


def event(
    time_s: float, kind: str, stage: str | None = None, done: float | None = None, attempt: int = 1, **data: Any
) -> JobEvent:
    values = {
        "id": 1,
        "job": "j",
        "time_s": time_s,
        "attempt": attempt if stage else 0,
        "stage": stage,
        "kind": kind,
        "message": "",
        "done": done,
    }
    return JobEvent.model_validate(values | {"data": data})


def run_of_a_job() -> list[JobEvent]:
    return [
        event(90, "state", state="QUEUED", trigger="queue"),
        event(100, "state", state="RUNNING", trigger="start"),
        event(101, "started", "prepare", machine=CLASS),
        event(105, "finished", "prepare", 1.0),
        event(106, "started", "fit", machine=CLASS),
        event(110, "step", "fit", 0.1),
        event(130, "step", "fit", 0.5),
        event(131, "log", "fit"),
        event(132, "step", "fit", 0.3),
        event(150, "finished", "fit", 1.0),
        event(151, "state", state="SUCCEEDED", trigger="succeed"),
    ]


def test_a_course_tells_when_each_tenth_was_reached() -> None:
    course = course_of(run_of_a_job())
    assert course is not None
    assert (course.machine, course.total_s) == (CLASS, 51.0)
    assert course.reached_s == {"prepare": (1.0, *[5.0] * 9), "fit": (6.0, 10.0, *[30.0] * 4, *[50.0] * 4)}


@pytest.mark.parametrize(
    "spoiled",
    [
        lambda events: events[:-1],
        lambda events: [
            *events[:-1],
            event(151, "state", state="QUEUED", trigger="lose"),
            event(152, "state", state="RUNNING", trigger="start"),
            events[-1],
        ],
        lambda events: [
            event(107, "started", "fit", attempt=2, machine=CLASS)
            if one.kind == "started" and one.stage == "fit"
            else one
            for one in events
        ],
        lambda events: [one for one in events if one.kind != "started"],
        lambda events: [
            event(102, "finished", "fit", 1.0) if one.kind == "finished" and one.stage == "fit" else one
            for one in events
        ],
        lambda events: [one for one in events if not (one.kind == "finished" and one.stage == "fit")],
    ],
    ids=[
        "not ended",
        "lost meanwhile",
        "second attempt",
        "unknown machine",
        "clock stepped back",
        "stage never finished",
    ],
)
def test_nothing_is_learned_from_a_broken_run(spoiled: Any) -> None:
    assert course_of(run_of_a_job()) is not None
    assert course_of(spoiled(run_of_a_job())) is None


def test_tenths_end_with_the_stage() -> None:
    assert [tenth_of(done) for done in (0.0, 0.09, 0.1, 0.3, 0.999, 1.0)] == [0, 0, 1, 3, 9, 9]


def past(factor: float) -> PastRun:
    """A run that takes 10 s to prepare and 100 s to fit, at an even pace; all times are multiplied by the factor."""
    reached = {"prepare": (1.0, *[10.0] * 9), "fit": tuple(10.0 + 10.0 * k for k in range(10))}
    scaled = {stage: tuple(factor * one for one in times) for stage, times in reached.items()}
    return PastRun(
        size=SIZE, course=Course.model_validate({"machine": CLASS, "reached_s": scaled, "total_s": 110 * factor})
    )


RUNS = [past(factor) for factor in (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2)]


def limits(position: Position) -> tuple[float, float]:
    told = time_range(SIZE.features, position, RUNS)
    assert told.low_s is not None
    assert told.high_s is not None
    assert told.past_jobs == len(RUNS)
    return told.low_s, told.high_s


def test_what_remains_shrinks_with_the_position() -> None:
    for position, truth in (
        (Position(), 110),
        (Position("fit"), 100),
        (Position("fit", 5), 50),
        (Position("fit", 9), 10),
    ):
        low, high = limits(position)
        assert low < truth < high < 2 * truth


def test_a_job_that_was_slow_so_far_stays_slow() -> None:
    even, slow = (limits(Position("fit", 5, took_s=took_s)) for took_s in (60.0, 120.0))
    assert slow[0] > even[1]
    assert math.log(slow[1] / slow[0]) > math.log(even[1] / even[0])


def test_time_without_news_is_taken_into_account() -> None:
    before, after = (limits(Position("fit", 5, since_s=since_s)) for since_s in (0.0, 45.0))
    assert after[0] < before[0]
    assert after[1] + 45 > before[1]
    assert time_range(SIZE.features, Position("fit", 5, since_s=5000.0), RUNS).low_s is None


def test_without_enough_or_alike_runs_there_is_a_reason_and_no_range() -> None:
    few = time_range(SIZE.features, Position(), RUNS[:3])
    assert (few.low_s, few.high_s, few.past_jobs) == (None, None, 3)
    assert few.reason == "3 jobs like this one have succeeded on such a machine, and 5 are needed to tell a time."
    wild = time_range(SIZE.features, Position(), [past(10.0**k) for k in range(6)])
    assert wild.low_s is None
    assert "differ too much" in (wild.reason or "")


def test_ranges_follow_each_other() -> None:
    first, second = TimeRange(low_s=1, high_s=3, past_jobs=9), TimeRange(low_s=10, high_s=20, past_jobs=7)
    assert second.after([first], [], slots=1) == TimeRange(low_s=11, high_s=23, past_jobs=7)


def test_a_range_begins_when_a_place_is_free() -> None:
    def lasting(low_s: float, high_s: float) -> TimeRange:
        return TimeRange(low_s=low_s, high_s=high_s, past_jobs=5)

    short, long, last = lasting(1, 2), lasting(10, 20), lasting(100, 200)
    assert last.after([long], [], slots=2) == last  # the second place is free
    assert last.after([short, long], [], slots=2) == lasting(101, 202)
    assert last.after([short, long], [long], slots=2) == lasting(
        110, 220
    )  # the one ahead takes the first free place, for 11 to 22 s
    assert last.after([short, short, long], [], slots=2) == lasting(
        101, 202
    )  # one of them captures beside two in their places
    assert last.after([], [long, short], slots=1) == lasting(111, 222)


def test_runs_beside_others_are_compared_by_how_many_there_were() -> None:
    alone = [past(factor) for factor in (0.9, 1.0, 1.1) for _ in range(3)]
    shared = [past(2 * factor) for factor in (0.9, 1.0, 1.1) for _ in range(3)]
    shared = [run.model_copy(update={"course": run.course.model_copy(update={"beside": 2.0})}) for run in shared]
    for beside, truth_s in ((1.0, 110), (2.0, 220)):
        told = time_range(SIZE.features, Position(), [*alone, *shared], beside)
        assert told.low_s is not None
        assert told.high_s is not None
        assert told.low_s < truth_s < told.high_s
        assert told.high_s / told.low_s < 2


def test_size_is_read_from_the_description_of_the_capture(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "mine", images=3)
    whole = size_of(JobSpec(capture=capture, samples_per_pixel=32, max_steps=5))
    assert whole == JobSize(pixels=3 * 48, samples=32, steps=5)
    assert size_of(JobSpec(capture=capture, pixel_step=2, solver="adam", adam_steps=70)) == JobSize(
        pixels=36, samples=64, steps=70
    )
    assert size_of(JobSpec(rig=RigSpec(mouth=capture))) == JobSize(pixels=3 * 48, samples=64, steps=12)
    (capture / "capture.json").write_text("[" * 100_000)
    assert size_of(JobSpec(capture=capture)) is None
    assert size_of(JobSpec(capture=tmp_path / "nowhere")) is None


def test_options_that_change_what_is_done_make_another_method() -> None:
    job = JobSpec(capture=Path("/a"))
    assert method_of(job) == method_of(JobSpec(capture=Path("/b"), seed=7, samples_per_pixel=8))
    for option, value in (("workers", 4), ("stains", True), ("kind", "jaw"), ("device", "cuda")):
        assert method_of(job) != method_of(job.model_copy(update={option: value}))


def test_the_class_of_a_machine_names_what_makes_it_fast(tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Fast 9000\nflags\t\t: fpu\n")
    device = tmp_path / "driver" / "nvidia" / "gpus" / "0000:01:00.0"
    device.mkdir(parents=True)
    (device / "information").write_text("Model: \t\t H100\nIRQ: 12\n")
    assert machine_class(tmp_path).startswith("Fast 9000, ")
    assert machine_class(tmp_path).endswith(" GiB, H100")
    assert machine_class(tmp_path / "nowhere").startswith("unknown processor, ")


def test_an_interrupted_stage_has_no_range_and_the_next_one_has(tmp_path: Path) -> None:
    capture = str(write_capture(tmp_path / "mine"))
    repository = Repository(sqlite_url(tmp_path / DATABASE_FILE))
    remember_runs(tmp_path, capture, (900.0, 950.0, 1000.0, 1050.0, 1100.0))
    ranges = TimeRanges(repository, lambda spec: spec, lambda _: None, machine_class())
    job = repository.create(JobSpec(capture=Path(capture)), None).job

    def told() -> TimeRange:
        found = ranges.of(repository.get(job.id))
        assert found is not None
        return found

    assert told().low_s is not None
    for attempt in (1, 2):
        lease = repository.lease(job.id, "me", 60)
        assert (told().low_s is None) == (attempt == 2)
        with repository.address_of(lease).open() as log:
            assert log.begin_stage("prepare", machine=machine_class()) == attempt
            assert (told().low_s is None) == (attempt == 2)
            if attempt == 2:
                log.append(attempt, StageEvent(stage="prepare", kind="finished", done=1.0))
        if attempt == 1:
            repository.lose()
            assert told().reason == "It was interrupted; the next stage will tell a time again."
    assert told().low_s is not None
    repository.close()


def test_a_slab_has_a_reason_and_no_range(tmp_path: Path) -> None:
    repository = Repository(sqlite_url(tmp_path / DATABASE_FILE))
    ranges = TimeRanges(repository, lambda spec: spec, lambda _: None, machine_class())
    told = ranges.of(repository.create(JobSpec(kind="slab", capture=tmp_path), None).job)
    assert told is not None
    assert told.low_s is None
    assert told.reason == "That depends on the sample; a wavelength takes a minute or more on two cores."
    repository.close()


def test_a_long_queue_is_asked_for_at_once(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture")
    repository = Repository(sqlite_url(tmp_path / DATABASE_FILE))
    remember_runs(tmp_path, str(capture), (900.0, 950.0, 1000.0, 1050.0, 1100.0))
    ranges = TimeRanges(repository, lambda spec: spec, lambda _: None, machine_class())
    asked = 0

    @sql.event.listens_for(repository.engine, "checkout")
    def _count(*_: object) -> None:
        nonlocal asked
        asked += 1

    def questions() -> int:
        job = repository.create(JobSpec(capture=capture), key=None).job
        before = asked
        told = ranges.of(job)
        assert told is not None
        assert told.high_s is not None
        return asked - before

    alone = questions()
    for _ in range(20):
        repository.create(JobSpec(capture=capture), key=None)
    assert questions() == alone
    repository.close()
