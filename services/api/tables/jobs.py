"""The tables of jobs and of the receipts of deleted ones, and the filter of job lists."""

from __future__ import annotations

from collections.abc import Iterator

import sqlalchemy as sql
from pydantic import Field

from services.api.tables.lifecycle import JobState
from services.client.errors import UnknownJobError
from services.core.geometry import Record
from services.core.owners import DEFAULT_GROUP, Viewer
from services.core.records import KindName
from services.pipeline.database import metadata

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
    sql.Column("owner", sql.Text, nullable=False, server_default=DEFAULT_GROUP),
    sql.Index("job_of_owner", "owner", "number"),
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
    sql.Column("exports", sql.Text),
    sql.Column("owner", sql.Text, nullable=False, server_default=DEFAULT_GROUP),
)


def unknown_job(job_id: str) -> UnknownJobError:
    """Return the error for a job that does not exist or belongs to another owner."""
    return UnknownJobError(f"There is no job {job_id}; list the jobs to see their ids.")


def unknown_deletion(job_id: str) -> UnknownJobError:
    """Return the error for a receipt that does not exist or belongs to another owner."""
    return UnknownJobError(f"No job {job_id} was deleted; check its id.")


class JobFilter(Record):
    """Filter of job lists; a field that is left out allows any job."""

    states: tuple[JobState, ...] = ()
    kind: KindName | None = None
    created_after_s: float | None = Field(default=None, description="Unix time")
    created_before_s: float | None = Field(default=None, description="Unix time")
    source: str | None = Field(
        default=None, description="text in the path of the capture or of the rig's mouth, in any case"
    )
    owner: str | None = Field(default=None, description="whose jobs; null: everybody's")
    by_name: bool = Field(default=False, description="whether source is looked for in the path's last part alone")

    def visible_to(self, viewer: Viewer) -> JobFilter:
        """Return the filter, restricted to what a viewer may see."""
        return self.model_copy(
            update={"owner": None if viewer.sees_all else viewer.owner, "by_name": not viewer.uses_paths}
        )

    def conditions(self) -> Iterator[sql.ColumnElement[bool]]:
        """Yield the conditions that a row of the job table must fulfil."""
        if self.states:
            yield sql.or_(
                *(job_table.c.state == state.value for state in sorted(set(self.states)))
            )  # each once, as SQLite nests no more than 1000 of them
        if self.kind is not None:
            yield job_table.c.kind == self.kind
        if self.created_after_s is not None:
            yield job_table.c.created_s > self.created_after_s
        if self.created_before_s is not None:
            yield job_table.c.created_s < self.created_before_s
        if self.source is not None:
            path = job_table.c.source
            above = sql.func.rtrim(path, sql.func.replace(path, "/", ""))
            searched = sql.func.replace(path, above, "") if self.by_name else path
            yield searched.icontains(self.source, autoescape=True)
        if self.owner is not None:
            yield job_table.c.owner == self.owner
