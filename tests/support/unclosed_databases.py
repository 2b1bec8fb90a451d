"""Warn about unclosed SQLite connections on every Python version as 3.13 does, and name the test that opened them.

Python versions before 3.13 close such connections silently when they are garbage-collected, so a leak would show only
with a newer Python.
"""

from __future__ import annotations

import os
import sqlite3
import warnings
from functools import partial
from typing import Any


class WatchedConnection(sqlite3.Connection):
    """A connection that warns when it is garbage-collected without having been closed."""

    opened_in: str | None = None
    """The test that opened it; None where it could not be opened."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.opened_in = os.environ.get("PYTEST_CURRENT_TEST", "no test")

    def __del__(self) -> None:
        if self.opened_in is None:
            return
        try:
            self.total_changes  # noqa: B018
        except sqlite3.ProgrammingError as problem:
            if "closed" in str(problem):
                return
        told = f"A database that {self.opened_in} opened was never closed."
        warnings.warn(told, ResourceWarning, stacklevel=2, source=self)


def watch_databases() -> None:
    """Replace ``sqlite3.connect``, so that all further connections of this process are watched."""
    connect = partial(sqlite3.connect, factory=WatchedConnection)
    sqlite3.connect = sqlite3.dbapi2.connect = connect  # type: ignore[assignment]  # a replacement
