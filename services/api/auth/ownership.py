"""Finds the owner of what a request's path names, so that whoever may not see it is told that it is not there, whatever
the route.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import sqlalchemy as sql

from services.api.captures.table import capture_table, unknown_capture
from services.api.jobs.table import deletion_table, job_table, unknown_deletion, unknown_job
from services.core.errors import DentineError
from services.pipeline.database import Query

MAX_KNOWN = 20_000
"""Owners that are kept as they were read, as they never change; some 4 MB."""
_DELETIONS = "/v1/deletions/"


def _owner_by(name: sql.Column[str], owner: sql.Column[str]) -> Query:
    return Query(sql.select(owner).where(name == sql.bindparam("of")))


class OwnedKind:
    """A kind of thing that has an owner and that paths name."""

    def __init__(self, name: sql.Column[str], owner: sql.Column[str], absent: Callable[[str], DentineError]) -> None:
        self._query, self.absent = _owner_by(name, owner), absent
        self._known: dict[str, str] = {}

    def known_owner(self, name: str) -> str | None:
        """The owner, if it was looked up before."""
        return self._known.get(name)

    def find_owner(self, engine: sql.Engine, name: str) -> str | None:
        """The owner; None if there is no such thing."""
        if not (name.isascii() and name.isalnum()):
            return None
        rows = self._query.rows(engine, of=name)
        if not rows:
            return None
        if len(self._known) >= MAX_KNOWN:
            self._known.clear()
        owner = self._known[name] = str(rows[0][0])
        return owner


class Ownership:
    """The owners in one database."""

    def __init__(self, engine: sql.Engine) -> None:
        self.engine = engine
        self._jobs = OwnedKind(job_table.c.id, job_table.c.owner, unknown_job)
        self._captures = OwnedKind(capture_table.c.id, capture_table.c.owner, unknown_capture)
        self._deletions = OwnedKind(deletion_table.c.job, deletion_table.c.owner, unknown_deletion)

    def named_in(self, template: str, ids: Mapping[str, str]) -> tuple[OwnedKind, str] | None:
        """What of an owner a route's path names; None if nothing."""
        if "job_id" in ids:
            return (self._deletions if template.startswith(_DELETIONS) else self._jobs), ids["job_id"]
        if "capture" in ids:
            return self._captures, ids["capture"]
        return None
