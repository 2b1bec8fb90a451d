"""How long until a job ends: an 80 % range learned from past jobs that did the same on the same class of machine, or a
reason why there is none.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

from pydantic import Field

from services.api.captures.descriptions import Describe, describe
from services.api.jobs.admission import queue_order
from services.api.jobs.forecast import MIN_OBSERVATIONS, Observation, foresee
from services.api.jobs.past_runs import TENTHS, PastRun, tenth_of
from services.api.jobs.records import Job
from services.api.jobs.repository import Repository
from services.api.jobs.size import method_of, size_of
from services.api.tables.lifecycle import JobState
from services.core.events import JobEvent
from services.core.geometry import Record
from services.core.records import JobSpec
from services.core.stage import StageName
from services.pipeline.event_log import EventLog, JobProgress
from services.pipeline.stages import stages_of

SIZE_SLOPE = 0.5
"""Prior mean of the slope of a duration's logarithm over that of each size: half way between no dependence (0) and
proportionality (1)."""

SHORTEST_S = 1e-3
"""Shortest duration in s of which a logarithm is taken."""
MAX_RANGE_RATIO = 100.0
"""Largest ratio of a range's limits. A wider range says nothing and is not given."""


class TimeRange(Record):
    """How long until a job ends; both limits are null where nothing honest can be said."""

    low_s: float | None = Field(
        default=None, description="from now; in 80 of 100 cases the job ends between the two limits"
    )
    high_s: float | None = Field(default=None, description="from now")
    past_jobs: int = Field(default=0, description="how many past jobs it is learned from")
    reason: str | None = Field(default=None, description="why there is no range")

    def after(self, running: Sequence[Self], ahead: Sequence[Self], slots: int) -> Self:
        """Return the range of a job that begins once the running jobs and those ahead of it leave a slot free.

        Lower limits are added to lower ones and upper to upper ones, because on a busy machine all jobs are late
        together.

        Args:
            running: ranges of the jobs that run.
            ahead: ranges of the queued jobs that start before this one.
            slots: largest number of jobs that run side by side.
        """
        if self.low_s is None or self.high_s is None:
            return self
        low_s, high_s = (
            _start_s(
                [getattr(one, limit) or 0.0 for one in running], [getattr(one, limit) or 0.0 for one in ahead], slots
            )
            for limit in ("low_s", "high_s")
        )
        fewer = min(one.past_jobs for one in (self, *running, *ahead))
        return self.model_copy(update={"low_s": self.low_s + low_s, "high_s": self.high_s + high_s, "past_jobs": fewer})


def _start_s(running_s: list[float], ahead_s: list[float], slots: int) -> float:
    """Return in how many s a slot is free, when each job ahead takes the slot that is free first."""
    free_s = sorted(running_s)[max(len(running_s) - slots, 0) :] + [0.0] * (slots - len(running_s))
    heapq.heapify(free_s)
    for lasts_s in ahead_s:
        heapq.heapreplace(free_s, free_s[0] + lasts_s)
    return free_s[0]


@dataclass(frozen=True)
class Position:
    """Progress of a job: the stage, and the tenth of it, that it has reached last."""

    stage: StageName | None = None
    """None before the first stage."""
    tenth: int = 0
    since_s: float = 0.0
    """Time in s since the job reached this position."""
    took_s: float | None = None
    """Time in s that the run had taken until then; None where it cannot be compared with past runs."""


def time_range(job_size: tuple[float, ...], position: Position, runs: list[PastRun], beside: float = 1.0) -> TimeRange:
    """Predict the remaining duration of a job at a position, from past runs.

    Args:
        job_size: features of its size, see ``JobSize.features``.
        runs: past runs, oldest first.
        beside: number of jobs that are expected to share the workers, this one included.
    """
    job_size = *job_size, math.log(beside)
    compared = [run for run in runs if position.stage is None or position.stage in run.course.reached_s]
    pairs = [_split(run, position) for run in compared]
    # Weight the time taken so far by the mean share of their whole duration that past runs had taken at this position.
    weight = (
        0.0
        if position.took_s is None or not pairs
        else sum(took_s / (took_s + remaining_s) for took_s, remaining_s in pairs) / len(pairs)
    )
    past = [
        Observation((*_features(run), weight * math.log(took_s)), remaining_s)
        for run, (took_s, remaining_s) in zip(compared, pairs, strict=True)
    ]
    pace = 0.0 if position.took_s is None else weight * math.log(max(position.took_s, SHORTEST_S))
    outlook = foresee(past, (*job_size, pace), (*[SIZE_SLOPE * (1 - weight)] * len(job_size), 1.0))
    if outlook is None:
        what = (
            f"{len(past)} jobs like this one have succeeded on such a machine, and {MIN_OBSERVATIONS} are needed to"
            " tell a time."
        )
        return TimeRange(past_jobs=len(past), reason=what)
    remaining_s = outlook.remaining_s(position.since_s)
    if remaining_s is None:
        return TimeRange(past_jobs=len(past), reason=f"It takes longer than {len(past)} jobs like it let expect.")
    if remaining_s[1] + position.since_s > MAX_RANGE_RATIO * (remaining_s[0] + position.since_s):
        return TimeRange(
            past_jobs=len(past),
            reason=f"The {len(past)} past jobs differ too much from each other, or from this one, to tell a time.",
        )
    return TimeRange(low_s=remaining_s[0], high_s=remaining_s[1], past_jobs=len(past))


def _features(run: PastRun) -> tuple[float, ...]:
    return *run.size.features, math.log(run.course.beside)


def _split(run: PastRun, position: Position) -> tuple[float, float]:
    """Return how long a past run had taken until a position, and how long it took from there, in s."""
    reached_s = 0.0 if position.stage is None else run.course.reached_s[position.stage][position.tenth]
    return max(reached_s, SHORTEST_S), max(run.course.total_s - reached_s, SHORTEST_S)


class TimeRanges:
    """Time ranges of the jobs of one server.

    Args:
        locate: returns a job's options with the folder of an uploaded capture.
        waits_for: returns what a queued job waits for other than the end of other jobs; None if nothing.
        machine: class of the machine that runs jobs; None where it is known only once they run.
        slots: largest number of jobs that run side by side.
        running: returns how many jobs share the workers now.
        describe: reads the description of a capture.
    """

    def __init__(
        self,
        repository: Repository,
        locate: Callable[[JobSpec], JobSpec],
        waits_for: Callable[[Job], str | None],
        machine: str | None,
        slots: int = 1,
        running: Callable[[], int] = lambda: 1,
        describe: Describe = describe,
    ) -> None:
        self._repository, self._locate, self._waits_for, self._machine = repository, locate, waits_for, machine
        self._slots, self._running, self._describe = slots, running, describe

    def learn(self, job: Job, beside: float = 1.0) -> None:
        """Record the run of a job that has succeeded; ``beside`` is the mean number of jobs that shared the workers
        meanwhile.
        """
        if (size := size_of(self._locate(job.spec), self._describe)) is not None:
            self._repository.past_runs.record(job.id, method_of(job.spec), size, beside)

    def of(self, job: Job) -> TimeRange | None:
        """How long until a job ends; None if it neither runs nor waits."""
        if job.state is JobState.RUNNING:
            return self._own_range(
                job, self._repository.events_of(job.id).progress(), _Past(self._repository), max(self._running(), 1)
            )
        if job.state is not JobState.QUEUED:
            return None
        unfinished, stages, past = self._repository.unfinished(), self._repository.begun(), _Past(self._repository)
        running = [one for one in unfinished if one.state is JobState.RUNNING]
        ahead = sorted(
            (one for one in unfinished if one.state is JobState.QUEUED and queue_order(one) < queue_order(job)),
            key=queue_order,
        )
        beside = min(self._slots, len(running) + len(ahead) + 1)
        own = self._own_range(job, stages.get(job.id, JobProgress()), past, beside)
        if own.low_s is None:
            return own
        earlier = [self._own_range(one, stages.get(one.id, JobProgress()), past, beside) for one in (*running, *ahead)]
        for one, range_ in zip((*running, *ahead), earlier, strict=True):
            if range_.reason is not None:
                return TimeRange(reason=f"Job {one.number} comes first: {range_.reason}")
        return own.after(earlier[: len(running)], earlier[len(running) :], self._slots)

    def _own_range(self, job: Job, stages: JobProgress, past: _Past, beside: float) -> TimeRange:
        # This is the range without the time for the jobs that go first.
        if (waits_for := self._waits_for(job)) is not None:
            return TimeRange(reason=waits_for)
        position = _position(job, stages.latest, self._repository.events_of(job.id))
        if position is None:
            return TimeRange(reason="It was interrupted; the next stage will tell a time again.")
        if job.spec.kind == "slab":
            return TimeRange(reason="That depends on the sample; a wavelength takes a minute or more on two cores.")
        size = size_of(self._locate(job.spec), self._describe)
        if size is None:
            return TimeRange(reason="The size of its capture cannot be read, so it cannot be compared with other jobs.")
        machine = (
            stages.started.data.get("machine") if stages.started is not None else self._machine
        ) or past.newest_machine
        return time_range(
            size.features, position, [] if machine is None else past.similar(method_of(job.spec), machine), beside
        )


class _Past:
    """Cache of past runs for the time in which one range is calculated, as the jobs in a queue are mostly of the same
    method.
    """

    def __init__(self, repository: Repository) -> None:
        self._runs = repository.past_runs
        self._similar: dict[tuple[str, str], list[PastRun]] = {}

    def similar(self, method: str, machine: str) -> list[PastRun]:
        """Return the newest runs of jobs of the same method on the same class of machine, oldest first."""
        if (method, machine) not in self._similar:
            self._similar[method, machine] = self._runs.similar(method, machine)
        return self._similar[method, machine]

    @cached_property
    def newest_machine(self) -> str | None:
        """Class of the machine on which a job succeeded last."""
        return self._runs.newest_machine()


def _position(job: Job, latest: Sequence[JobEvent], log: EventLog) -> Position | None:
    """Return the position of a job; None within a stage that was begun more than once, as past runs do not tell how
    much of it is left.
    """
    stages = stages_of(job.spec, [event.stage for event in latest])
    if job.state is JobState.QUEUED:
        if not latest:
            return Position()
        return Position(_next_stage(stages, latest[-1])) if latest[-1].kind == "finished" else None
    if not latest:
        return Position(since_s=time.time() - job.changed_s)
    last, tenth, reached_s = latest[-1], 0, latest[-1].time_s
    if last.stage is None or (last.kind != "finished" and (last.attempt > 1 or last.time_s < job.changed_s)):
        return None
    if last.kind == "finished":
        stage = _next_stage(stages, last)
        tenth = TENTHS - 1 if stage == last.stage else 0
    else:
        stage, tenth = last.stage, tenth_of(last.done or 0.0)
        reached_s = log.reached_s(stage, last.attempt, tenth / TENTHS) or reached_s
    is_whole = all(event.attempt == 1 and event.time_s >= job.changed_s for event in latest)
    is_compared = is_whole and (stage, tenth) != (stages[0], 0)  # before that nothing was done that tells a pace
    return Position(
        stage,
        tenth,
        max(time.time() - max(reached_s, job.changed_s), 0.0),
        reached_s - job.changed_s if is_compared else None,
    )


def _next_stage(stages: tuple[StageName, ...], event: JobEvent) -> StageName:
    """Return the stage after that of an event; after the last stage, the last one again."""
    return stages[min(stages.index(event.stage) + 1, len(stages) - 1)] if event.stage in stages else stages[0]
