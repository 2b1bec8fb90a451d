"""The audit log: who did what, when, from where, and how it ended. Rows are only ever added."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sql
from pydantic import Field

from services.core.geometry import Record
from services.core.redaction import redacted
from services.pipeline.database import metadata, writing

ID_LENGTH = 500
"""Largest number of characters of each stored id. An artifact's path, which the caller chooses, could be of any
length."""

audit_table = sql.Table(
    "audit",
    metadata,
    sql.Column("id", sql.Integer, primary_key=True),
    sql.Column("time_s", sql.Float, nullable=False),
    sql.Column("who", sql.Text, nullable=False),
    sql.Column("token", sql.Text),
    sql.Column("address", sql.Text, nullable=False),
    sql.Column("action", sql.Text, nullable=False),
    sql.Column("ids", sql.Text, nullable=False),
    sql.Column("outcome", sql.Integer, nullable=False),
    sql.Index("audit_of_who", "who", "id"),
    sqlite_autoincrement=True,
)

_INSERT = audit_table.insert()  # built once, as building the statement takes longer than executing it


class AuditEntry(Record):
    """One row of the audit log."""

    id: int = Field(description="grows")
    time_s: float = Field(description="Unix time")
    who: str = Field(description="name of the token, 'local' without one, or 'unknown' where it was refused")
    token: str | None = Field(description="public id of the token; claimed, not proven, where it was refused")
    address: str = Field(description="network address of the caller, or 'command line'")
    action: str = Field(description="method and route template, or command")
    ids: dict[str, str] = Field(
        description=(
            "what the route's path names; 'made' is the address of what was created, 'flashes' the acknowledgement of"
            " faster flashes, 'use' what the caller said that a file is for"
        )
    )
    outcome: int = Field(description="HTTP status of the answer")


@dataclass
class AuditedAction:
    """An action of a caller. Code that makes the change also writes the row, in the same transaction, where that is
    simple.
    """

    action: str
    address: str
    who: str = "unknown"
    token: str | None = None
    ids: dict[str, str] = field(default_factory=dict)
    is_written: bool = False

    def write(self, connection: sql.Connection, outcome: int) -> None:
        """Append the row inside the caller's transaction, unless it was written already."""
        if not self.is_written:
            ids = {name: redacted(value)[:ID_LENGTH] for name, value in self.ids.items()}
            row = {
                "time_s": time.time(),
                "who": self.who,
                "token": self.token,
                "address": self.address,
                "action": self.action,
            }
            connection.execute(_INSERT, row | {"ids": json.dumps(ids), "outcome": outcome})
            self.is_written = True


class AuditLog:
    """Reads and appends the rows of the audit table."""

    def __init__(self, engine: sql.Engine) -> None:
        self._engine = engine

    def append(self, audited: AuditedAction, outcome: int) -> None:
        """Append the row of an action in a transaction of its own, unless it was written already."""
        if not audited.is_written:
            with writing(self._engine) as connection:
                audited.write(connection, outcome)

    def page(self, limit: int, before: int | None = None, who: str | None = None) -> list[AuditEntry]:
        """Return up to ``limit`` rows, newest first, of those with an id below ``before`` and of the caller named
        ``who``.
        """
        query = sql.select(audit_table).order_by(audit_table.c.id.desc()).limit(limit)
        if before is not None:
            query = query.where(audit_table.c.id < before)
        if who is not None:
            query = query.where(audit_table.c.who == who)
        with self._engine.connect() as connection:
            return [_entry(row) for row in connection.execute(query).mappings()]


def _entry(row: Any) -> AuditEntry:
    return AuditEntry(**{name: row[name] for name in AuditEntry.model_fields} | {"ids": json.loads(row["ids"])})
