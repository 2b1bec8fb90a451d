"""Past runs of jobs that succeeded: when each run reached each tenth of each stage.

They have a table of their own because a fit has many events.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sqlalchemy as sql
from pydantic import Field

from services.api.jobs.size import JobSize
from services.api.tables.lifecycle import JobState, Trigger
from services.core.events import JobEvent
from services.core.geometry import Record
from services.core.stage import StageName
from services.pipeline.database import metadata, writing
from services.pipeline.event_log import EventLog, event_table

NEWEST = 40
"""Number of past runs that are learned from: enough for a range, few enough to follow a machine that changes."""

TENTHS = 10
"""Number of equal parts of a stage at whose beginnings the time is recorded."""

past_run_table = sql.Table(
    "past_run",
    metadata,
    sql.Column("job", sql.Text, primary_key=True),
    sql.Column("ended_s", sql.Float, nullable=False),
    sql.Column("method", sql.Text, nullable=False),
    sql.Column("machine", sql.Text, nullable=False),
    sql.Column("size", sql.Text, nullable=False),
    sql.Column("course", sql.Text, nullable=False),
    sql.Index("past_run_alike", "method", "machine", "ended_s"),
)


class Course(Record):
    """Times of one run from its start to its success, without an interruption."""

    machine: str = Field(description="class of the machines that ran its stages")
    reached_s: dict[StageName, tuple[float, ...]] = Field(
        description="by stage, from the start of the run until each tenth of it, its beginning first"
    )
    total_s: float
    beside: float = Field(
        default=1.0, ge=1, description="how many jobs shared the workers, this one included; mean over the run"
    )


class PastRun(Record):
    """Size and times of one past job."""

    size: JobSize
    course: Course


def tenth_of(done: float) -> int:
    """Return how many tenths of a stage are done at a fraction ``done``; the last tenth ends only with the stage."""
    return min(int(TENTHS * done + 1e-9), TENTHS - 1)


def course_of(events: Iterable[JobEvent]) -> Course | None:
    """Derive the course of a run from its events, oldest first; None if the job did not succeed, was interrupted, or
    the clock stepped back.
    """
    began_s = ended_s = None
    machines, reached = set[str](), dict[StageName, list[float]]()
    for event in events:
        if event.kind == "state":
            if event.data.get("trigger") == Trigger.START:
                if began_s is not None:
                    return None
                began_s = event.time_s
            elif event.data.get("state") == JobState.SUCCEEDED:
                ended_s = event.time_s
        elif event.stage is not None and began_s is not None:
            if event.attempt > 1:
                return None
            if event.kind == "started":
                machines.add(event.data.get("machine", ""))
            times = reached.setdefault(event.stage, [])
            tenths = TENTHS if event.kind == "finished" else 1 + tenth_of(event.done or 0.0)
            times += [event.time_s - began_s] * (tenths - len(times))
    times = [time_s for one in reached.values() for time_s in one]
    if (
        began_s is None
        or ended_s is None
        or not machines
        or "" in machines
        or any(len(one) < TENTHS for one in reached.values())
    ):
        return None
    if [0.0, *times, ended_s - began_s] != sorted([0.0, *times, ended_s - began_s]):
        return None
    return Course(
        machine="; ".join(sorted(machines)),
        reached_s={stage: tuple(one) for stage, one in reached.items()},
        total_s=ended_s - began_s,
    )


class PastRuns:
    """The table of past runs in one database."""

    def __init__(self, engine: sql.Engine) -> None:
        self._engine = engine

    def record(self, job_id: str, method: str, size: JobSize, beside: float = 1.0) -> None:
        """Record the run of a job that has succeeded, if it was not interrupted; ``beside`` is the mean number of jobs
        that shared the workers during the run, this one included.
        """
        course = course_of(EventLog(self._engine, job_id).every())
        if course is None:
            return
        course = course.model_copy(update={"beside": beside})
        row = {
            "job": job_id,
            "method": method,
            "machine": course.machine,
            "size": size.model_dump_json(),
            "course": course.model_dump_json(),
        }
        with writing(self._engine) as connection:
            ended_s = connection.scalar(
                sql.select(sql.func.max(event_table.c.time_s)).where(event_table.c.job == job_id)
            )
            if ended_s is not None:  # else the job was deleted meanwhile
                connection.execute(past_run_table.insert().values(row | {"ended_s": ended_s}))

    def similar(self, method: str, machine: str) -> list[PastRun]:
        """Return the newest runs of jobs of the same method on the same class of machine, oldest first."""
        similar = (past_run_table.c.method == method) & (past_run_table.c.machine == machine)
        query = sql.select(past_run_table).where(similar).order_by(past_run_table.c.ended_s.desc()).limit(NEWEST)
        with self._engine.connect() as connection:
            return [_run(row) for row in reversed(connection.execute(query).mappings().all())]

    def newest_machine(self) -> str | None:
        """Return the class of the machine on which a job succeeded last."""
        query = sql.select(past_run_table.c.machine).order_by(past_run_table.c.ended_s.desc()).limit(1)
        with self._engine.connect() as connection:
            return connection.scalar(query)


def _run(row: Any) -> PastRun:
    return PastRun(size=JobSize.model_validate_json(row["size"]), course=Course.model_validate_json(row["course"]))
