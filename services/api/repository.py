"""Jobs in SQLite beside the event table; a change of state and its event are one transaction."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sql
from pydantic import Field

from services.api.events import EventAddress, EventLog, event_table, insert_event, metadata, open_database, writing
from services.api.lifecycle import JobState, Transition, Trigger, apply
from services.core.errors import DentineError, JobStateError, UnknownJobError
from services.core.geometry import Record
from services.core.records import JobSpec
from services.core.stage import StageName

job_table = sql.Table(
    "job",
    metadata,
    sql.Column("number", sql.Integer, primary_key=True),
    sql.Column("id", sql.Text, nullable=False, unique=True),
    sql.Column("key", sql.Text, unique=True),
    sql.Column("state", sql.Text, nullable=False, index=True),
    sql.Column("created_s", sql.Float, nullable=False),
    sql.Column("changed_s", sql.Float, nullable=False),
    sql.Column("spec", sql.Text, nullable=False),
    sql.Column("failure", sql.Text),
    sqlite_autoincrement=True,
)


class Failure(Record):
    """Why a job failed."""

    code: str = Field(description="stable and machine-readable")
    message: str = Field(description="one sentence that names the thing and the remedy")
    exit_status: int = Field(description="what `dentine run` would have exited with")
    stage: StageName | None = None

    @classmethod
    def of(cls, problem: DentineError, stage: StageName | None) -> Self:
        """The failure that an error means."""
        return cls(code=problem.code, message=problem.message, exit_status=problem.exit_status, stage=stage)


class Job(Record):
    """One job as the API shows it."""

    id: str
    number: int = Field(description="grows with every submission")
    state: JobState
    created_s: float = Field(description="Unix time of the submission")
    changed_s: float = Field(description="Unix time of the last change of state")
    spec: JobSpec
    failure: Failure | None


@dataclass(frozen=True)
class Creation:
    """What a submission led to."""

    job: Job
    is_new: bool


class Repository:
    """The database of a server."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._engine = open_database(path)

    @property
    def engine(self) -> sql.Engine:
        """For other tables of the same database."""
        return self._engine

    def close(self) -> None:
        """Close every connection."""
        self._engine.dispose()

    def create(self, spec: JobSpec, key: str | None) -> Creation:
        """Insert a job as QUEUED, or find the one that was submitted with this idempotency key.

        Raises:
            JobStateError: the key was used for other options.
        """
        options = spec.model_dump_json()
        with writing(self._engine) as connection:
            if key is not None and (earlier := connection.execute(sql.select(job_table).where(job_table.c.key == key)).mappings().first()):
                if earlier["spec"] != options:
                    raise JobStateError(f"Idempotency key {key!r} was used for a job with other options; choose another key.")
                return Creation(_job(earlier), is_new=False)
            job_id, now = secrets.token_hex(6), time.time()
            row = {"id": job_id, "key": key, "state": JobState.SUBMITTED, "created_s": now, "changed_s": now, "spec": options}
            connection.execute(job_table.insert().values(row))
            insert_event(connection, job_id, 0, kind="state", message="Submitted.", data={"state": JobState.SUBMITTED})
            self._apply(connection, job_id, Trigger.QUEUE)
            return Creation(self._find(connection, job_id), is_new=True)

    def get(self, job_id: str) -> Job:
        """One job.

        Raises:
            UnknownJobError: there is none with this id.
        """
        with self._engine.connect() as connection:
            return self._find(connection, job_id)

    def page(self, limit: int, before: int | None = None, state: JobState | None = None) -> list[Job]:
        """Newest jobs first, those with a number below ``before``."""
        query = sql.select(job_table).order_by(job_table.c.number.desc()).limit(limit)
        if before is not None:
            query = query.where(job_table.c.number < before)
        if state is not None:
            query = query.where(job_table.c.state == state)
        with self._engine.connect() as connection:
            return [_job(row) for row in connection.execute(query).mappings()]

    def next_queued(self) -> Job | None:
        """The job that has waited longest."""
        query = sql.select(job_table).where(job_table.c.state == JobState.QUEUED).order_by(job_table.c.number).limit(1)
        with self._engine.connect() as connection:
            row = connection.execute(query).mappings().first()
            return _job(row) if row else None

    def apply(self, job_id: str, trigger: Trigger, failure: Failure | None = None) -> Transition:
        """Apply a trigger to a job's state.

        Raises:
            UnknownJobError: there is no such job. JobStateError: its state does not take the trigger.
        """
        with writing(self._engine) as connection:
            return self._apply(connection, job_id, trigger, failure)

    def lose_unfinished(self) -> list[str]:
        """Tell every job that was queued or running that no process works on it; call when the server starts."""
        lost = [JobState.SUBMITTED, JobState.QUEUED, JobState.RUNNING, JobState.CANCELLING]
        with writing(self._engine) as connection:
            ids = list(connection.scalars(sql.select(job_table.c.id).where(job_table.c.state.in_(lost)).order_by(job_table.c.number)))
            for job_id in ids:
                self._apply(connection, job_id, Trigger.LOSE)
        return ids

    def events_of(self, job_id: str) -> EventLog:
        """The job's events."""
        return EventLog(self._engine, job_id)

    def address_of(self, job_id: str) -> EventAddress:
        """Where another process appends the job's events."""
        return EventAddress(self._path, job_id)

    def newest_event(self) -> int:
        """Id of the last event of any job."""
        with self._engine.connect() as connection:
            return connection.scalar(sql.select(sql.func.max(event_table.c.id))) or 0

    def _find(self, connection: sql.Connection, job_id: str) -> Job:
        row = connection.execute(sql.select(job_table).where(job_table.c.id == job_id)).mappings().first()
        if row is None:
            raise UnknownJobError(f"There is no job {job_id}; list the jobs to see their ids.")
        return _job(row)

    def _apply(self, connection: sql.Connection, job_id: str, trigger: Trigger, failure: Failure | None = None) -> Transition:
        before = self._find(connection, job_id).state
        transition = apply(before, trigger)
        if transition.state is before and trigger is not Trigger.LOSE:
            return transition
        changes = {"state": transition.state, "changed_s": time.time(), "failure": failure.model_dump_json() if failure else None}
        connection.execute(job_table.update().where(job_table.c.id == job_id).values(changes))
        data: dict[str, Any] = {"state": transition.state, "trigger": trigger} | ({"failure": failure.model_dump()} if failure else {})
        message = failure.message if failure else f"{transition.state.capitalize()}."
        insert_event(connection, job_id, 0, kind="state", message=message, data=data)
        return transition


def _job(row: Any) -> Job:
    fields = {name: row[name] for name in ("id", "number", "state", "created_s", "changed_s")}
    failure = Failure.model_validate_json(row["failure"]) if row["failure"] else None
    return Job(**fields, spec=JobSpec.model_validate_json(row["spec"]), failure=failure)
