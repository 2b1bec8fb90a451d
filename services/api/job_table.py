"""The tables of jobs and of the receipts of deleted ones, and what jobs are found by."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import sqlalchemy as sql
from pydantic import Field

from services.api.database import metadata
from services.api.lifecycle import JobState
from services.core.geometry import Record

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
    sql.Column("request_id", sql.Text),
    sql.Column("kind", sql.Text),
    sql.Column("source", sql.Text),
    sql.Column("name", sql.Text),
    sqlite_autoincrement=True,
)

deletion_table = sql.Table(
    "deletion",
    metadata,
    sql.Column("job", sql.Text, primary_key=True),
    sql.Column("deleted_s", sql.Float, nullable=False),
    sql.Column("submitted_s", sql.Float, nullable=False),
    sql.Column("files", sql.Integer, nullable=False),
    sql.Column("bytes", sql.BigInteger, nullable=False),
    sql.Column("digest", sql.Text, nullable=False),
)


class JobFilter(Record):
    """Which jobs to list; what is left out allows any."""

    states: tuple[JobState, ...] = ()
    kind: Literal["tooth", "jaw"] | None = None
    created_after_s: float | None = Field(default=None, description="Unix time")
    created_before_s: float | None = Field(default=None, description="Unix time")
    source: str | None = Field(default=None, description="text in the path of the capture or of the rig's mouth, in any case")

    def conditions(self) -> Iterator[sql.ColumnElement[bool]]:
        """What a row of the job table must fulfil."""
        if self.states:
            yield sql.or_(*(job_table.c.state == state.value for state in sorted(set(self.states))))  # each once, as SQLite nests no more than 1000 of them
        if self.kind is not None:
            yield job_table.c.kind == self.kind
        if self.created_after_s is not None:
            yield job_table.c.created_s > self.created_after_s
        if self.created_before_s is not None:
            yield job_table.c.created_s < self.created_before_s
        if self.source is not None:
            yield job_table.c.source.icontains(self.source, autoescape=True)
