"""Browser sessions that were ended before they expired.

A copied cookie is worthless once its owner has signed out.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import sqlalchemy as sql

from services.pipeline.database import Query, metadata, writing

ended_session_table = sql.Table(
    "ended_session",
    metadata,
    sql.Column("sha256", sql.Text, primary_key=True),
    sql.Column("expires_s", sql.Float, nullable=False),
)
_ONE = Query(sql.select(ended_session_table.c.sha256).where(ended_session_table.c.sha256 == sql.bindparam("of")))


class EndedSessions:
    """The table of ended sessions, shared by all servers of a database. A session is named by the SHA-256 of its
    cookie's claim.

    Args:
        clock: Unix time.
    """

    def __init__(self, engine: sql.Engine, clock: Callable[[], float] = time.time) -> None:
        self._engine, self._clock = engine, clock

    def has(self, sha256: str) -> bool:
        """Whether the session was ended."""
        return bool(_ONE.rows(self._engine, of=sha256))

    def add(self, sha256: str, expires_s: float) -> None:
        """End a session, and delete the rows of sessions that have expired."""
        table = ended_session_table
        with writing(self._engine) as connection:
            connection.execute(table.delete().where((table.c.expires_s <= self._clock()) | (table.c.sha256 == sha256)))
            connection.execute(table.insert().values(sha256=sha256, expires_s=expires_s))
