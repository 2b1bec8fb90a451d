"""The states of workers as their scheduler reports them, and how many jobs have succeeded."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, get_args

import sqlalchemy as sql
from pydantic import Field

from services.api.jobs.repository import Repository
from services.api.tables.jobs import job_table
from services.api.tables.lifecycle import JobState
from services.core.geometry import Record
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.placement import DOME, STAGES
from services.core.stage import StageName
from services.pipeline.database import Query
from services.pipeline.workers import FAULT_KEY, NOT_STARTED, Workers

HOUR_S, DAY_S = 3600.0, 86400.0
_TASK = re.compile(rf"({'|'.join(get_args(StageName))})-(\w+)-[0-9a-f]{{8}}(-.*)?")
"""Pattern of the key of a stage's task, or of a task that the stage has made; see ``pipeline``."""
_SUCCEEDED = Query(
    sql.select(
        sql.func.count(),
        sql.func.coalesce(sql.func.sum(sql.case((job_table.c.changed_s > sql.bindparam("hour_ago_s"), 1), else_=0)), 0),
    ).where(job_table.c.state == JobState.SUCCEEDED.value, job_table.c.changed_s > sql.bindparam("day_ago_s"))
)

_IS_AT_WORK = (job_table.c.state == JobState.RUNNING.value) | (job_table.c.state == JobState.CANCELLING.value)
_OWN_AT_WORK = Query(sql.select(job_table.c.id).where(job_table.c.owner == sql.bindparam("of_owner"), _IS_AT_WORK))


class WorkerTask(Record):
    """A stage that a worker runs."""

    stage: StageName
    job: str | None = Field(description="id; null where it is a job of others")


class WorkerState(Record):
    """One worker process."""

    name: str = Field(description="as its scheduler calls it")
    host: str = Field(description="where it runs")
    threads: int = Field(description="tasks that it takes on at once; renderers are processes beside it")
    tasks: tuple[WorkerTask, ...] = Field(description="stages that it runs, wholly or in part, or will run next")
    memory_bytes: int = Field(description="resident size of its process, renderers not counted")
    memory_limit_bytes: int | None = Field(description="beyond it its tasks are stopped; null where it has none")
    has_dome: bool = Field(description="whether captures may run there")
    runs_stages: bool = Field(description="whether all other stages may run there, as it has shown that it can")
    fault: str = Field(
        description="what it cannot do of what it was started for, and the remedy; empty where nothing is wrong"
    )
    heard_s: float = Field(description="Unix time of its last sign of life")


class WorkerList(Record):
    """The workers of a server and what they get done."""

    workers: tuple[WorkerState, ...] = Field(description="by name")
    sentence: str = Field(description="how many there are, or why there are none yet")
    succeeded_last_hour: int = Field(description="jobs, of every server of the database")
    succeeded_last_day: int = Field(description="jobs in 24 h")


def list_workers(workers: Workers, repository: Repository, viewer: Viewer = LOCAL_VIEWER) -> WorkerList:
    """List the workers, from the scheduler, and count the jobs that succeeded, from the database. Jobs that the viewer
    may not see have no id.

    Raises:
        SchedulerLostError: the scheduler does not answer.
    """
    cluster = workers.census()
    found = (
        ()
        if cluster is None
        else tuple(
            sorted(
                _states(cluster.workers, cluster.processing, _visibility(viewer, repository)), key=lambda one: one.name
            )
        )
    )
    now_s = time.time()
    in_day, in_hour = _SUCCEEDED.rows(repository.engine, hour_ago_s=now_s - HOUR_S, day_ago_s=now_s - DAY_S)[0]
    return WorkerList(
        workers=found,
        sentence=_sentence(found, is_started=cluster is not None),
        succeeded_last_hour=in_hour,
        succeeded_last_day=in_day,
    )


def _visibility(viewer: Viewer, repository: Repository) -> Callable[[str], bool]:
    if viewer.sees_all:
        return lambda _: True
    own = {str(job) for (job,) in _OWN_AT_WORK.rows(repository.engine, of_owner=viewer.owner)}
    return own.__contains__


def _states(
    workers: Mapping[str, Mapping[str, Any]],
    processing: Mapping[str, Iterable[Any]],
    is_visible: Callable[[str], bool] = lambda _: True,
) -> Iterable[WorkerState]:
    for address, worker in workers.items():
        keys = (_TASK.fullmatch(str(key)) for key in processing.get(address, ()))
        yield WorkerState(
            name=str(worker["name"]),
            host=str(worker["host"]),
            threads=worker["nthreads"],
            tasks=_tasks((key for key in keys if key is not None), is_visible),
            memory_bytes=worker["metrics"].get("memory", 0),
            memory_limit_bytes=worker["memory_limit"] or None,
            has_dome=bool(worker["resources"].get(DOME)),
            runs_stages=bool(worker["resources"].get(STAGES)),
            fault=str(worker.get(FAULT_KEY) or ""),
            heard_s=worker["last_seen"],
        )


def _tasks(keys: Iterable[re.Match[str]], is_visible: Callable[[str], bool]) -> tuple[WorkerTask, ...]:
    """Return each stage once, of however many tasks the worker has."""
    found = dict.fromkeys((key[1], key[2]) for key in keys)
    return tuple(
        WorkerTask.model_validate({"stage": stage, "job": job if is_visible(job) else None}) for stage, job in found
    )


def _sentence(found: tuple[WorkerState, ...], *, is_started: bool) -> str:
    if not is_started:
        return NOT_STARTED
    if not found:
        return "The scheduler has no workers; start some, jobs wait for them."
    busy = sum(bool(one.tasks) for one in found)
    return f"{len(found)} worker{'s' if len(found) > 1 else ''}, {busy} busy."
