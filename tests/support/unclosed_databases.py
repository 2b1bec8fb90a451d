"""SQLite connections that nobody closed are told on every Python as 3.13 tells them, with the test that opened them.

Before 3.13 the interpreter closes them silently when they are collected, so that a leak would be found only by those
who have a newer one.
"""

from __future__ import annotations

import os
import sqlite3
import warnings
from functools import partial
from typing import Any


class WatchedConnection(sqlite3.Connection):
    """A connection that warns where it is collected before it was closed."""

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
    """Have all connections of this process watched from now on."""
    connect = partial(sqlite3.connect, factory=WatchedConnection)
    sqlite3.connect = sqlite3.dbapi2.connect = connect  # type: ignore[assignment]
