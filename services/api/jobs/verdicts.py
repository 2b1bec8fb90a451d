"""Verdicts on how well the fits of jobs went.

They are read from the events with which fits finish, not from the folders of jobs, because many jobs are listed at once
and a folder may hang.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sql
from pydantic import ValidationError
from pydantic_core import from_json

from services.api.jobs.records import Job
from services.api.tables.lifecycle import JobState
from services.core.results import Verdict
from services.core.verdict import VERDICT
from services.pipeline.event_log import event_table

MAX_CACHED = 1024
"""Largest number of verdicts that are kept in memory, the same as of jobs."""


_NOT_CACHED: Any = object()


class Verdicts:
    """The verdicts on the jobs of one database.

    They are kept by job and time of success: a fit that has succeeded is judged once, and one that runs again succeeds
    at another time.
    """

    def __init__(self, engine: sql.Engine) -> None:
        self._engine = engine
        self._cache: OrderedDict[tuple[str, float], Verdict | None] = OrderedDict()

    def with_verdicts(self, jobs: Sequence[Job]) -> list[Job]:
        """Return the jobs, those that have succeeded with their verdicts."""
        succeeded = {(job.id, job.changed_s) for job in jobs if job.state is JobState.SUCCEEDED}
        cached = {
            key: verdict for key in succeeded if (verdict := self._cache.get(key, _NOT_CACHED)) is not _NOT_CACHED
        }
        if missing := succeeded - cached.keys():
            found = self._read([job_id for job_id, _ in missing])
            cached |= {key: found.get(key[0]) for key in missing}
            self._store(cached)
        judged = ((job, cached.get((job.id, job.changed_s))) for job in jobs)
        return [job if verdict is None else job.model_copy(update={"verdict": verdict}) for job, verdict in judged]

    def _read(self, job_ids: list[str]) -> dict[str, Verdict | None]:
        columns = event_table.c
        of_fits = (columns.kind == "finished") & (columns.stage == "fit") & columns.job.in_(job_ids)
        with self._engine.connect() as connection:
            rows = connection.execute(sql.select(columns.job, columns.data).where(of_fits).order_by(columns.id)).all()
        return {job: _verdict(from_json(data)) for job, data in rows}  # the last fit's, where there were several

    def _store(self, found: dict[tuple[str, float], Verdict | None]) -> None:
        self._cache |= found
        while len(self._cache) > MAX_CACHED:
            self._cache.popitem(last=False)


def _verdict(data: dict[str, Any]) -> Verdict | None:
    try:
        return Verdict.model_validate(data.get(VERDICT))
    except ValidationError:
        return None  # of a fit by a version that judged otherwise, or not at all
