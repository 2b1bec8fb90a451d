"""Finds the owner of the job, receipt or capture that a request's path names. A caller who may not see it gets, on
every route, the answer that it does not exist.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import sqlalchemy as sql

from services.api.tables.captures import capture_table, unknown_capture
from services.api.tables.jobs import deletion_table, job_table, unknown_deletion, unknown_job
from services.core.errors import DentineError
from services.pipeline.database import Query

MAX_CACHED = 20_000
"""Largest number of owners of one kind that are kept in memory, some 4 MB. They are never read again because owners
never change."""
_DELETIONS = "/v1/deletions/"


def _owner_by(name: sql.Column[str], owner: sql.Column[str]) -> Query:
    return Query(sql.select(owner).where(name == sql.bindparam("of")))


class OwnedKind:
    """A kind of object that has an owner and that paths name: jobs, captures or receipts of deletions."""

    def __init__(
        self, name: sql.Column[str], owner: sql.Column[str], unknown_error: Callable[[str], DentineError]
    ) -> None:
        self._query, self.unknown_error = _owner_by(name, owner), unknown_error
        self._cached_owners: dict[str, str] = {}

    def cached_owner(self, name: str) -> str | None:
        """Return the owner if it was looked up before, else None."""
        return self._cached_owners.get(name)

    def find_owner(self, engine: sql.Engine, name: str) -> str | None:
        """Look up the owner in the database; None if there is no such object."""
        if not (name.isascii() and name.isalnum()):
            return None
        rows = self._query.rows(engine, of=name)
        if not rows:
            return None
        if len(self._cached_owners) >= MAX_CACHED:
            self._cached_owners.clear()
        owner = self._cached_owners[name] = str(rows[0][0])
        return owner


class Ownership:
    """The owners of jobs, captures and receipts in one database."""

    def __init__(self, engine: sql.Engine) -> None:
        self.engine = engine
        self._jobs = OwnedKind(job_table.c.id, job_table.c.owner, unknown_job)
        self._captures = OwnedKind(capture_table.c.id, capture_table.c.owner, unknown_capture)
        self._deletions = OwnedKind(deletion_table.c.job, deletion_table.c.owner, unknown_deletion)

    def named_in(self, template: str, ids: Mapping[str, str]) -> tuple[OwnedKind, str] | None:
        """Return the kind and the id of the owned object that a route's path names; None if it names none."""
        if "job_id" in ids:
            return (self._deletions if template.startswith(_DELETIONS) else self._jobs), ids["job_id"]
        if "capture" in ids:
            return self._captures, ids["capture"]
        return None
