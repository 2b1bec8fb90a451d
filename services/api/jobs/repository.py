"""Stores jobs in the database, beside the event table; a change of state and its event are one transaction.

The server that runs a job holds a lease: a number, one more than that of any lease before, and a time at which it
expires. A lease that is not renewed is lost, and later reports of its holder about the job are refused.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any

import sqlalchemy as sql

from services.api.auth.departures import Departure
from services.api.jobs.past_runs import PastRuns, past_run_table
from services.api.jobs.records import Creation, Deletion, Failure, Job, Lease
from services.api.jobs.verdicts import Verdicts
from services.api.migrations import upgrade
from services.api.tables.jobs import JobFilter, deletion_table, job_table, unknown_deletion, unknown_job
from services.api.tables.lifecycle import JobState, Transition, Trigger, apply
from services.api.tables.outbox import collect_changes
from services.client.errors import JobStateError
from services.core.errors import FencedError
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.records import JobSpec
from services.pipeline.database import Query, open_database, writing
from services.pipeline.event_log import (
    EventAddress,
    EventLog,
    JobProgress,
    event_table,
    insert_event,
    latest_of_stages,
    lease_table,
    progress_of_jobs,
)

KNOWN_JOBS = 1024
"""Largest number of parsed jobs, and of their options, that are kept in memory."""


_IS_UNFINISHED = (job_table.c.state == JobState.RUNNING.value) | (job_table.c.state == JobState.QUEUED.value)
# These queries are built once, because building a query takes longer than executing it.
_JOBS = sql.select(*(job_table.c[name] for name in Job.model_fields if name in job_table.c))
_ONE = Query(_JOBS.where(job_table.c.id == sql.bindparam("of")))
_WITH_KEY = Query(_JOBS.where(job_table.c.key == sql.bindparam("of_key")))
_NEWEST_EVENTS = Query(
    sql.select(event_table.c.job, sql.func.max(event_table.c.id).label("newest"))
    .where(event_table.c.id > sql.bindparam("after"))
    .group_by(event_table.c.job)
)
_UNFINISHED = Query(_JOBS.where(_IS_UNFINISHED).order_by(job_table.c.number))
_BEGUN = Query(latest_of_stages(sql.select(job_table.c.id).where(_IS_UNFINISHED)))
_INSERT = job_table.insert()


@lru_cache(64)
def _listing(only: JobFilter, *, is_first: bool) -> Query:
    """Build the query of the newest ``most`` jobs; unless it is the first page, of those with a number below
    ``before``.
    """
    query = (
        _JOBS.where(*only.conditions())
        .order_by(job_table.c.number.desc())
        .limit(sql.bindparam("most", type_=sql.Integer))
    )
    return Query(query if is_first else query.where(job_table.c.number < sql.bindparam("before")))


class Repository:
    """The jobs in the database of a server. Its tables are upgraded to this version when it is opened.

    Args:
        clock: Unix time in s; servers that share a database must agree on it to within the length of a lease.
    """

    def __init__(self, url: str, clock: Callable[[], float] = time.time) -> None:
        self._url, self._clock = url, clock
        self.engine = open_database(url)
        upgrade(self.engine)
        self.past_runs = PastRuns(self.engine)
        self._spec_of = lru_cache(KNOWN_JOBS)(
            JobSpec.model_validate_json
        )  # the same text always means the same options, which never change
        self._verdicts = Verdicts(self.engine)
        self._known = lru_cache(KNOWN_JOBS)(self._read)

    def close(self) -> None:
        """Close every connection."""
        self.engine.dispose()

    def create(
        self,
        spec: JobSpec,
        key: str | None,
        request_id: str | None = None,
        name: str | None = None,
        viewer: Viewer = LOCAL_VIEWER,
    ) -> Creation:
        """Insert a job as QUEUED, or find the one that its owner submitted with this idempotency key.

        Raises:
            JobStateError: the key was used for other options.
        """
        options = spec.model_dump_json()
        with writing(self.engine) as connection:
            own_key = viewer.key(key)
            if key is not None and (earlier := connection.execute(_WITH_KEY.statement, {"of_key": own_key}).first()):
                return Creation(self._same(earlier, spec, key), is_new=False)
            job_id, now = secrets.token_hex(6), self._clock()
            row = {
                "id": job_id,
                "key": own_key,
                "state": JobState.SUBMITTED,
                "created_s": now,
                "changed_s": now,
                "spec": options,
                "request_id": request_id,
            }
            row |= {
                "kind": spec.kind,
                "source": str(spec.rig.mouth if spec.rig else spec.capture),
                "name": name,
                "owner": viewer.owner,
            }
            connection.execute(_INSERT, row)
            insert_event(connection, job_id, 0, kind="state", message="Submitted.", data={"state": JobState.SUBMITTED})
            self._apply(connection, job_id, Trigger.QUEUE)
            return Creation(self._find(connection, job_id), is_new=True)

    def rename(self, job_id: str, name: str | None) -> Job:
        """Give a job another label, or none.

        Raises:
            UnknownJobError: there is no such job.
        """
        with writing(self.engine) as connection:
            connection.execute(job_table.update().where(job_table.c.id == job_id).values(name=name))
            renamed = self._find(connection, job_id)
        return self._verdicts.with_verdicts([renamed])[0]

    def submitted(self, spec: JobSpec, key: str, viewer: Viewer = LOCAL_VIEWER) -> Job | None:
        """The job that its owner submitted with this idempotency key, if there is one.

        Raises:
            JobStateError: the key was used for other options.
        """
        rows = _WITH_KEY.rows(self.engine, of_key=viewer.key(key))
        return self._same(rows[0], spec, key) if rows else None

    def get(self, job_id: str) -> Job:
        """One job.

        Raises:
            UnknownJobError: there is none with this id.
        """
        return self._verdicts.with_verdicts([self._only(_ONE.rows(self.engine, of=job_id), job_id)])[0]

    def visible_ids(self, job_ids: Iterable[str], viewer: Viewer) -> set[str]:
        """Return the ids of those jobs that exist and that a viewer may see."""
        found = (_ONE.rows(self.engine, of=job_id) for job_id in job_ids)
        return {job.id for job in self._jobs(rows[0] for rows in found if rows) if viewer.may_see(job.owner)}

    def page(self, limit: int, before: int | None = None, only: JobFilter | None = None) -> list[Job]:
        """Return up to ``limit`` jobs, newest first, of those with a number below ``before``."""
        values = {"most": limit} | ({} if before is None else {"before": before})
        return self._verdicts.with_verdicts(
            self._jobs(_listing(only or JobFilter(), is_first=before is None).rows(self.engine, **values))
        )

    def unfinished(self) -> list[Job]:
        """Return the jobs that run or wait, in the order of their submission."""
        return self._jobs(_UNFINISHED.rows(self.engine))

    def begun(self) -> dict[str, JobProgress]:
        """Return how far the stages are of each job that runs or waits and was begun, by job."""
        return progress_of_jobs(_BEGUN.rows(self.engine))

    def queued(self) -> list[Job]:
        """Return the jobs that wait, in the order of their submission."""
        query = _JOBS.where(job_table.c.state == JobState.QUEUED).order_by(job_table.c.number)
        with self.engine.connect() as connection:
            return self._jobs(connection.execute(query))

    def lease(self, job_id: str, holder: str, seconds: float) -> Lease:
        """Start a queued job under a new lease of so many ``seconds``.

        Raises:
            UnknownJobError: there is no such job. JobStateError: it is not queued.
        """
        with writing(self.engine) as connection:
            self._apply(connection, job_id, Trigger.START)
            number, until_s = 1 + self._lease_number(connection, job_id), self._clock() + seconds
            connection.execute(lease_table.delete().where(lease_table.c.job == job_id))
            connection.execute(lease_table.insert().values(job=job_id, number=number, holder=holder, until_s=until_s))
            return Lease(self._find(connection, job_id), number)

    def renew(self, lease: Lease, seconds: float) -> bool:
        """Extend a lease; False if another holder has the job by now."""
        held = (lease_table.c.job == lease.job.id) & (lease_table.c.number == lease.number)
        with writing(self.engine) as connection:
            return bool(
                connection.execute(lease_table.update().where(held).values(until_s=self._clock() + seconds)).rowcount
            )

    def settle(self, lease: Lease, trigger: Trigger, failure: Failure | None = None) -> Transition:
        """Apply the trigger that the holder of a lease reports of its job, and end the lease.

        Raises:
            FencedError: another holder has the job by now. JobStateError: its state does not take the trigger.
        """
        with writing(self.engine) as connection:
            if (newest := self._lease_number(connection, lease.job.id)) != lease.number:
                raise FencedError(
                    f"Job {lease.job.id} was taken over under lease {newest}; lease {lease.number} has no say in it."
                )
            connection.execute(lease_table.update().where(lease_table.c.job == lease.job.id).values(until_s=0.0))
            return self._apply(connection, lease.job.id, trigger, failure)

    def apply(
        self, job_id: str, trigger: Trigger, failure: Failure | None = None, spec: JobSpec | None = None
    ) -> Transition:
        """Apply a trigger to a job's state; ``spec`` replaces the job's options in the same transaction.

        Raises:
            UnknownJobError: there is no such job. JobStateError: its state does not take the trigger.
        """
        with writing(self.engine) as connection:
            transition = self._apply(connection, job_id, trigger, failure)
            if spec is not None:
                connection.execute(
                    job_table.update().where(job_table.c.id == job_id).values(spec=spec.model_dump_json())
                )
            return transition

    def append_message(self, job_id: str, message: str) -> None:
        """Append a sentence to the events of a job, if the job still waits."""
        is_waiting = sql.select(job_table.c.id).where(job_table.c.id == job_id, job_table.c.state == JobState.QUEUED)
        with writing(self.engine) as connection:
            if connection.scalar(is_waiting) is not None:
                insert_event(connection, job_id, 0, kind="log", message=message)

    def lose(self) -> list[str]:
        """Apply ``lose`` to every job under way, as no process works on it any more; returns their ids."""
        return self._lose(sql.true())

    def lose_expired(self, keep: Iterable[Lease] = (), length_s: float = math.inf) -> list[str]:
        """Apply ``lose`` to the jobs under way that have no lease, or an expired one; returns their ids.

        Args:
            keep: leases that hold whatever the clock says: the caller's own, as the caller knows that it works on those
                jobs.
            length_s: length of every lease in s. A lease that ends more than twice as far ahead was taken before the
                clock stepped back, and counts as expired.
        """
        now_s = self._clock()
        held: sql.ColumnElement[bool] = lease_table.c.until_s.between(now_s, now_s + 2 * length_s)
        for one in keep:
            held |= (lease_table.c.job == one.job.id) & (lease_table.c.number == one.number)
        return self._lose(job_table.c.id.not_in(sql.select(lease_table.c.job).where(held)))

    def _lose(self, which: sql.ColumnElement[bool]) -> list[str]:
        running = job_table.c.state.in_([JobState.RUNNING, JobState.CANCELLING])
        with writing(self.engine) as connection:
            ids = list(
                connection.scalars(sql.select(job_table.c.id).where(running, which).order_by(job_table.c.number))
            )
            for job_id in ids:
                self._apply(connection, job_id, Trigger.LOSE)
        return ids

    def forget(self, job_id: str, files: int, size: int, digest: str, exports: tuple[Departure, ...] = ()) -> Deletion:
        """Delete the rows of a job whose files are gone, and store a receipt, which names the exports that left.

        Raises:
            UnknownJobError: there is no such job. JobStateError: it is not being deleted.
        """
        with writing(self.engine) as connection:
            job = self._find(connection, job_id)
            if job.state is not JobState.DELETING:
                raise JobStateError(f"Job {job_id} is {job.state}; delete it first.")
            collect_changes(connection, self._clock())  # before the events are deleted with the job
            times = {"deleted_s": self._clock(), "submitted_s": job.created_s}
            receipt = Deletion(job=job_id, files=files, bytes=size, digest=digest, exports=exports, **times)
            connection.execute(deletion_table.insert().values(receipt.as_row() | {"owner": job.owner}))
            for column in (event_table.c.job, lease_table.c.job, past_run_table.c.job, job_table.c.id):
                connection.execute(column.table.delete().where(column == job_id))
            return receipt

    def deletion(self, job_id: str) -> Deletion:
        """Return the receipt of a deleted job.

        Raises:
            UnknownJobError: no job of this id was deleted.
        """
        with self.engine.connect() as connection:
            row = (
                connection.execute(sql.select(deletion_table).where(deletion_table.c.job == job_id)).mappings().first()
            )
        if row is None:
            raise unknown_deletion(job_id)
        return Deletion.of_row(row)

    def ended_before(self, time_s: float) -> list[str]:
        """Return the ids of the jobs that ended before a time and of those whose deletion was begun, in the order of
        their submission.
        """
        ended = job_table.c.state.in_([state for state in JobState if state.is_final]) & (
            job_table.c.changed_s < time_s
        )
        query = (
            sql.select(job_table.c.id)
            .where(ended | (job_table.c.state == JobState.DELETING))
            .order_by(job_table.c.number)
        )
        with self.engine.connect() as connection:
            return list(connection.scalars(query))

    def events_of(self, job_id: str) -> EventLog:
        """Return the event log of a job."""
        return EventLog(self.engine, job_id)

    def address_of(self, lease: Lease) -> EventAddress:
        """Return the address under which another process appends the events of a leased job."""
        return EventAddress(self._url, lease.job.id, lease.number, lease.job.request_id)

    def newest_event(self) -> int:
        """Return the id of the last event of any job; 0 if there is none."""
        with self.engine.connect() as connection:
            return connection.scalar(sql.select(sql.func.max(event_table.c.id))) or 0

    def newest_events(self, after: int) -> dict[str, int]:
        """Return the jobs that have events after an id, each with the id of its last event."""
        return {str(job): int(newest) for job, newest in _NEWEST_EVENTS.rows(self.engine, after=after)}

    def _lease_number(self, connection: sql.Connection, job_id: str) -> int:
        return connection.scalar(sql.select(lease_table.c.number).where(lease_table.c.job == job_id)) or 0

    def _find(self, connection: sql.Connection, job_id: str) -> Job:
        return self._only(connection.execute(_ONE.statement, {"of": job_id}).all(), job_id)

    def _only(self, rows: Sequence[Sequence[Any]], job_id: str) -> Job:
        if not rows:
            raise unknown_job(job_id)
        return self._job(rows[0])

    def _same(self, row: Sequence[Any], spec: JobSpec, key: str) -> Job:
        job = self._job(row)
        if job.spec != spec:
            raise JobStateError(f"Idempotency key {key!r} was used for a job with other options; choose another key.")
        return job

    def _jobs(self, rows: Iterable[Any]) -> list[Job]:
        return [self._job(row) for row in rows]

    def _job(self, row: Sequence[Any]) -> Job:
        return self._known(*row)

    def _read(self, *row: Any) -> Job:
        job_id, number, state, created_s, changed_s, spec, failure, request_id, name, owner = row
        return Job(
            id=job_id,
            number=number,
            state=state,
            created_s=created_s,
            changed_s=changed_s,
            spec=self._spec_of(spec),
            failure=Failure.model_validate_json(failure) if failure else None,
            request_id=request_id,
            name=name,
            owner=owner,
        )

    def _apply(
        self, connection: sql.Connection, job_id: str, trigger: Trigger, failure: Failure | None = None
    ) -> Transition:
        before = self._find(connection, job_id).state
        transition = apply(before, trigger)
        if transition.state is before and trigger is not Trigger.LOSE:
            return transition
        changes = {
            "state": transition.state,
            "changed_s": self._clock(),
            "failure": failure.model_dump_json() if failure else None,
        }
        connection.execute(job_table.update().where(job_table.c.id == job_id).values(changes))
        data: dict[str, Any] = {"state": transition.state, "trigger": trigger} | (
            {"failure": failure.model_dump()} if failure else {}
        )
        message = failure.message if failure else f"{transition.state.capitalize()}."
        insert_event(connection, job_id, 0, kind="state", message=message, data=data)
        return transition
