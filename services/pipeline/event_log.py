"""The event table: every process that works on a job appends to it, and everybody who follows the job reads it.

A server keeps the table in its own database beside the jobs; ``dentine run`` keeps one in the job's folder.

The process that runs a server's job holds a lease with a number. Every start of a stage is checked against the newest
number, so that a process that stalled and was replaced cannot start another stage.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args

import sqlalchemy as sql
from pydantic_core import from_json

from services.core.errors import FencedError
from services.core.events import JobEvent
from services.core.stage import StageEvent, StageName
from services.pipeline.database import Query, metadata, open_database, sqlite_url, writing

PAGE = 1000
"""Number of events that are read at once."""
EVENTS_FILE = "events.sqlite"
"""Name of the file with the event table of a job's folder."""

event_table = sql.Table(
    "event",
    metadata,
    sql.Column("id", sql.Integer, primary_key=True),
    sql.Column("job", sql.Text, nullable=False),
    sql.Column("time_s", sql.Float, nullable=False),
    sql.Column("attempt", sql.Integer, nullable=False),
    sql.Column("stage", sql.Text),
    sql.Column("kind", sql.Text, nullable=False),
    sql.Column("message", sql.Text, nullable=False),
    sql.Column("done", sql.Float),
    sql.Column("data", sql.Text, nullable=False),
    sql.Index("event_of_job", "job", "id"),
    sql.Index("event_of_stage", "job", "stage", "id"),
    sql.Index("event_of_kind", "job", "kind", "id"),
    sqlite_autoincrement=True,
)
lease_table = sql.Table(
    "lease",
    metadata,
    sql.Column("job", sql.Text, primary_key=True),
    sql.Column("number", sql.Integer, nullable=False),
    sql.Column("holder", sql.Text, nullable=False),
    sql.Column("until_s", sql.Float, nullable=False),
)


_COLUMNS = tuple(JobEvent.model_fields)


def latest_of_stages(jobs: sql.Select[Any]) -> sql.Select[Any]:
    """Query for the last event of each stage of certain jobs, and for the last event that started each.

    ``progress_of_jobs`` reads its rows. Each event is found by one look-up in an index, however many events there are.

    Args:
        jobs: query for the ids of the jobs, as column ``id``.
    """
    those, columns = jobs.subquery(), event_table.c
    last_ids = (
        sql.select(sql.func.max(columns.id))
        .where(columns.job == those.c.id, columns.stage == stage, is_meant)
        .scalar_subquery()
        for stage in get_args(StageName)
        for is_meant in (sql.true(), columns.kind == "started")
    )
    of_stage = sql.union_all(*(sql.select(last_id).select_from(those) for last_id in last_ids))
    earlier = event_table.alias()
    last_done = (
        sql.select(earlier.c.done)
        .where(
            earlier.c.job == event_table.c.job,
            earlier.c.stage == event_table.c.stage,
            earlier.c.attempt == event_table.c.attempt,
        )
        .where(earlier.c.done.is_not(None))
        .order_by(earlier.c.id.desc())
        .limit(1)
        .scalar_subquery()
    )
    return (
        sql.select(event_table, last_done.label("last_done"))
        .where(event_table.c.id.in_(of_stage))
        .order_by(event_table.c.id)
    )


# Queries are built once, because building one takes longer than running it.
_LATEST = Query(latest_of_stages(sql.select(sql.bindparam("of").label("id"))))
_NEWEST_ID = Query(sql.select(sql.func.max(event_table.c.id)).where(event_table.c.job == sql.bindparam("of")))
_TIMED_DATA = Query(
    sql.select(event_table.c.id, event_table.c.time_s, event_table.c.data)
    .where(
        event_table.c.job == sql.bindparam("of"),
        event_table.c.kind == sql.bindparam("of_kind"),
        event_table.c.id > sql.bindparam("after"),
    )
    .order_by(event_table.c.id)
    .limit(PAGE)
)
# Events of an overtaken attempt are refused, so the last event of a stage is one of its newest attempt, and one row is
# enough, however long the fit.
_NEWEST_ATTEMPT = (
    sql.select(event_table.c.attempt)
    .where(event_table.c.job == sql.bindparam("of"), event_table.c.stage == sql.bindparam("of_stage"))
    .order_by(event_table.c.id.desc())
    .limit(1)
)
_INSERT = event_table.insert()


@cache
def _page_of(columns: tuple[str, ...]) -> Query:
    """Query for at most ``most`` events of job ``of`` with an id above ``after``, oldest first.

    Each of the columns must equal its parameter, ``of_`` and the column's name.
    """
    query = sql.select(event_table).where(
        event_table.c.job == sql.bindparam("of"), event_table.c.id > sql.bindparam("after")
    )
    query = query.where(*(event_table.c[name] == sql.bindparam(f"of_{name}") for name in columns))
    return Query(query.order_by(event_table.c.id).limit(sql.bindparam("most", type_=sql.Integer)))


class JobProgress(NamedTuple):
    """The progress of a job's stages."""

    latest: Sequence[JobEvent] = ()
    """The last event of each stage, oldest first; its ``done`` is that of the last event of the same attempt that
    states one."""
    started: JobEvent | None = None
    """The event that started the newest stage; None before the first start."""


class TimedData(NamedTuple):
    """The Unix time of an event, and its data."""

    time_s: float
    data: dict[str, Any]


@dataclass(frozen=True)
class EventAddress:
    """The address of the table for a job's events, small enough to be sent to a worker."""

    url: str = field(repr=False)
    job: str
    lease: int = 0
    """Number of the lease under which the job is run; 0 where only one process can run it."""
    request_id: str | None = None
    """Id of the request that submitted the job; None where there was none."""

    @contextmanager
    def open(self) -> Iterator[EventLog]:
        """Open the table for this job and close it afterwards."""
        engine = open_database(self.url)
        try:
            yield EventLog(engine, self.job, self.lease, self.request_id)
        finally:
            engine.dispose()


def folder_events(folder: Path, job: str = "local") -> EventAddress:
    """The address of the event table in a job's folder; the table is made if it does not exist."""
    address = EventAddress(sqlite_url(folder / EVENTS_FILE), job)
    engine = open_database(address.url)
    metadata.create_all(engine, tables=[event_table, lease_table])
    engine.dispose()
    return address


def insert_event(
    connection: sql.Connection, job: str, attempt: int, event: StageEvent | None = None, **columns: Any
) -> None:
    """Append one row inside the caller's transaction."""
    if event is not None:
        columns = {
            "stage": event.stage,
            "kind": event.kind,
            "message": event.message,
            "done": event.done,
            "data": event.data,
        } | columns
    row = {"job": job, "attempt": attempt, "time_s": time.time(), "stage": None, "message": "", "done": None} | columns
    connection.execute(_INSERT, row | {"data": json.dumps(columns.get("data", {}), allow_nan=False)})


class EventLog:
    """The events of one job."""

    def __init__(self, engine: sql.Engine, job: str, lease: int = 0, request_id: str | None = None) -> None:
        self._engine, self.job, self._lease, self._request_id = engine, job, lease, request_id

    def begin_stage(self, stage: StageName, known: int = 0, machine: str | None = None) -> int:
        """Record the start of a stage and return the number of its attempt, which is one more than any earlier one.

        Args:
            known: newest attempt by another source than this table.
            machine: class of the machine on which the stage starts.

        Raises:
            FencedError: another process has taken over the job.
        """
        with writing(self._engine) as connection:
            newest = connection.scalar(sql.select(lease_table.c.number).where(lease_table.c.job == self.job)) or 0
            if newest > self._lease:
                raise FencedError(
                    f"The job was taken over under lease {newest}; lease {self._lease} may not start stage {stage}."
                )
            attempt = 1 + max(known, self._newest_attempt(connection, stage))
            origin = {} if self._request_id is None else {"job": self.job, "request_id": self._request_id}
            origin |= {} if machine is None else {"machine": machine}
            insert_event(connection, self.job, attempt, StageEvent(stage=stage, kind="started", data=origin))
        return attempt

    def append(self, attempt: int, event: StageEvent) -> None:
        """Append a stage's event.

        Raises:
            FencedError: a newer attempt has started this stage.
        """
        with writing(self._engine) as connection:
            newest = self._newest_attempt(connection, event.stage)
            if newest > attempt:
                raise FencedError(
                    f"Attempt {attempt} of stage {event.stage} was overtaken by attempt {newest}; its events are"
                    " refused."
                )
            insert_event(connection, self.job, attempt, event)

    def read(self, after: int = 0, limit: int = PAGE, **only: str | int | None) -> list[JobEvent]:
        """The job's events with an id above ``after``, oldest first; ``only`` gives the value that a column must have,
        or None for any value.
        """
        selected = {name: value for name, value in only.items() if value is not None}
        values = {f"of_{name}": value for name, value in selected.items()}
        return [
            _event(row)
            for row in _page_of(tuple(selected)).rows(self._engine, of=self.job, after=after, most=limit, **values)
        ]

    def data_of(self, kind: str) -> Iterator[TimedData]:
        """Time and data of all events of one kind, oldest first; a curve of hundreds of events needs no more."""
        after: int | None = 0
        while after is not None:
            rows = _TIMED_DATA.rows(self._engine, of=self.job, of_kind=kind, after=after)
            data = from_json("[" + ",".join(data for _, _, data in rows) + "]")
            yield from map(TimedData, (time_s for _, time_s, _ in rows), data)
            after = rows[-1][0] if len(rows) == PAGE else None

    def every(self, **only: str | int | None) -> Iterator[JobEvent]:
        """All of the job's events, oldest first, a page at a time; ``only`` as in ``read``."""
        after = 0
        while events := self.read(after, PAGE, **only):
            yield from events
            after = events[-1].id

    def reached_s(self, stage: StageName, attempt: int, done: float) -> float | None:
        """Unix time at which an attempt had done this fraction of its stage; None as long as it has not."""
        columns = event_table.c
        of_attempt = (columns.job == self.job) & (columns.stage == stage) & (columns.attempt == attempt)
        enough = (columns.done >= done) if done > 0 else sql.true()
        with self._engine.connect() as connection:
            first_s: float | None = connection.scalar(
                sql.select(sql.func.min(columns.time_s)).where(of_attempt, enough)
            )
            return first_s

    def progress(self) -> JobProgress:
        """The progress of the job's stages."""
        return progress_of_jobs(_LATEST.rows(self._engine, of=self.job)).get(self.job, JobProgress())

    def latest(self) -> Sequence[JobEvent]:
        """The last event of each stage, oldest first."""
        return self.progress().latest

    def newest_id(self) -> int:
        """Id of the job's last event, 0 before the first."""
        return _NEWEST_ID.rows(self._engine, of=self.job)[0][0] or 0

    def _newest_attempt(self, connection: sql.Connection, stage: StageName) -> int:
        return connection.scalar(_NEWEST_ATTEMPT, {"of": self.job, "of_stage": stage}) or 0


def progress_of_jobs(rows: Iterable[Sequence[Any]]) -> dict[str, JobProgress]:
    """The progress of each job, by id, from the rows of ``latest_of_stages``."""
    latest: dict[str, dict[str | None, JobEvent]] = {}
    started: dict[str, JobEvent] = {}
    for row in rows:  # oldest first
        event = _event(row[:-1], done=row[-1])
        of_job = latest.setdefault(event.job, {})
        of_job.pop(event.stage, None)
        of_job[event.stage] = event
        if event.kind == "started":
            started[event.job] = event
    return {job: JobProgress(tuple(of_job.values()), started.get(job)) for job, of_job in latest.items()}


def _event(row: Sequence[Any], **changes: Any) -> JobEvent:
    # Rows are not validated again, because this program has written them and a curve has hundreds.
    fields = dict(zip(_COLUMNS, row, strict=True))
    return JobEvent.model_construct(**fields | {"data": from_json(fields["data"])} | changes)
