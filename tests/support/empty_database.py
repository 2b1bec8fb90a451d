"""New databases that have all tables: copies of one that took the steps of the upgrade, which take longer than most
tests.
"""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path

from services.api.migrations import upgrade
from services.pipeline.database import open_database, sqlite_url


@lru_cache(maxsize=1)
def _upgraded() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "jobs.sqlite"
        engine = open_database(sqlite_url(file))
        upgrade(engine)
        engine.dispose()
        return file.read_bytes()


def empty_database(file: Path) -> str:
    """Write a database without rows to ``file``; returns its URL."""
    file.write_bytes(_upgraded())
    return sqlite_url(file)
