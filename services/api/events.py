"""The one event table: every process that works on a job appends to it, everybody who watches reads it.

A server keeps it in its own database beside the jobs; ``dentine run`` keeps one in the job's folder. SQLite in WAL mode with
``BEGIN IMMEDIATE`` and a busy timeout, so that read-then-write transactions of several processes never lose an update.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import sqlalchemy as sql
from pydantic import Field

from services.core.errors import FencedError
from services.core.geometry import Record
from services.core.stage import StageEvent, StageName

EVENTS_FILE = "events.sqlite"
"""Name of a job folder's own event table."""

metadata = sql.MetaData()
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
    sqlite_autoincrement=True,
)


class JobEvent(Record):
    """One row of the event table."""

    id: int = Field(description="grows over all jobs; what Last-Event-ID names")
    job: str
    time_s: float = Field(description="Unix time")
    attempt: int = Field(description="attempt of the stage; 0 for a change of state")
    stage: StageName | None
    kind: Literal["state", "started", "progress", "log", "step", "preview", "finished"]
    message: str
    done: float | None = Field(description="fraction of the stage done, 0 to 1")
    data: dict[str, Any]


@dataclass(frozen=True)
class EventAddress:
    """Where a job's events go, small enough to travel to a worker."""

    database: Path
    job: str

    @contextmanager
    def open(self) -> Iterator[EventLog]:
        """Open the table for this job and close it afterwards."""
        engine = open_database(self.database)
        try:
            yield EventLog(engine, self.job)
        finally:
            engine.dispose()


def open_database(path: Path) -> sql.Engine:
    """Open or create the database with every table that is known by now."""
    path.parent.mkdir(parents=True, exist_ok=True)
    engine = sql.create_engine(f"sqlite:///{path}", hide_parameters=True)  # errors end in logs

    @sql.event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # SQLAlchemy then emits BEGIN itself, see below
        connection.execute("PRAGMA busy_timeout=5000")
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")

    @sql.event.listens_for(engine, "begin")
    def _begin(connection: sql.Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE" if connection.get_execution_options().get("writes") else "BEGIN")

    metadata.create_all(engine)
    return engine


def writing(engine: sql.Engine) -> AbstractContextManager[sql.Connection]:
    """A transaction that holds the write lock from its first statement, so that what it reads stays true."""
    return engine.execution_options(writes=True).begin()


def insert_event(connection: sql.Connection, job: str, attempt: int, event: StageEvent | None = None, **columns: Any) -> None:
    """Append one row inside the caller's transaction."""
    if event is not None:
        columns = {"stage": event.stage, "kind": event.kind, "message": event.message, "done": event.done, "data": event.data} | columns
    row = {"job": job, "attempt": attempt, "time_s": time.time(), "stage": None, "message": "", "done": None} | columns
    connection.execute(event_table.insert().values(row | {"data": json.dumps(columns.get("data", {}), allow_nan=False)}))


class EventLog:
    """The events of one job."""

    def __init__(self, engine: sql.Engine, job: str) -> None:
        self._engine, self.job = engine, job

    def begin_stage(self, stage: StageName, lease: int = 0) -> int:
        """Record that the stage starts and return its attempt: one more than any before, in this table or in ``lease``."""
        with writing(self._engine) as connection:
            attempt = 1 + max(lease, self._newest_attempt(connection, stage))
            insert_event(connection, self.job, attempt, StageEvent(stage=stage, kind="started"))
        return attempt

    def append(self, attempt: int, event: StageEvent) -> None:
        """Append a stage's event.

        Raises:
            FencedError: a newer attempt has started this stage.
        """
        with writing(self._engine) as connection:
            newest = self._newest_attempt(connection, event.stage)
            if newest > attempt:
                raise FencedError(f"Attempt {attempt} of stage {event.stage} was overtaken by attempt {newest}; its events are refused.")
            insert_event(connection, self.job, attempt, event)

    def read(self, after: int = 0, limit: int = 1000) -> list[JobEvent]:
        """The job's events with an id above ``after``, oldest first."""
        query = sql.select(event_table).where(event_table.c.job == self.job, event_table.c.id > after).order_by(event_table.c.id).limit(limit)
        with self._engine.connect() as connection:
            return [_event(row) for row in connection.execute(query).mappings()]

    def latest(self) -> list[JobEvent]:
        """The last event of each stage, oldest first, its ``done`` filled from the last event of that attempt that has one."""
        of_stage = (
            sql.select(sql.func.max(event_table.c.id)).where(event_table.c.job == self.job, event_table.c.stage.is_not(None)).group_by(event_table.c.stage)
        )
        earlier = event_table.alias()
        last_done = (
            sql.select(earlier.c.done)
            .where(earlier.c.job == event_table.c.job, earlier.c.stage == event_table.c.stage, earlier.c.attempt == event_table.c.attempt)
            .where(earlier.c.done.is_not(None))
            .order_by(earlier.c.id.desc())
            .limit(1)
            .scalar_subquery()
        )
        query = sql.select(event_table, last_done.label("last_done")).where(event_table.c.id.in_(of_stage)).order_by(event_table.c.id)
        with self._engine.connect() as connection:
            return [_event(row, done=row["last_done"]) for row in connection.execute(query).mappings()]

    def newest_id(self) -> int:
        """Id of the job's last event, 0 before the first."""
        with self._engine.connect() as connection:
            return connection.scalar(sql.select(sql.func.max(event_table.c.id)).where(event_table.c.job == self.job)) or 0

    def _newest_attempt(self, connection: sql.Connection, stage: StageName) -> int:
        query = sql.select(sql.func.max(event_table.c.attempt)).where(event_table.c.job == self.job, event_table.c.stage == stage)
        return connection.scalar(query) or 0


def _event(row: Any, **changes: Any) -> JobEvent:
    return JobEvent(**{name: row[name] for name in JobEvent.model_fields} | {"data": json.loads(row["data"])} | changes)
