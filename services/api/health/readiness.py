"""Checks whether a submitted job would run; everything that it needs is tried, not assumed."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import sqlalchemy as sql
from pydantic import Field

from services.api.jobs.admission import KEPT_FREE_BYTES
from services.core.errors import DentineError, PlatformError, StoreError
from services.core.geometry import Record
from services.pipeline.dask_tls import Certificates
from services.pipeline.database import writing
from services.pipeline.event_log import event_table
from services.pipeline.workers import require_scheduler

PROBE_S = 1.0
"""Longest time in s that the database may take to grant a write."""
STORE_PROBE_S = 3.0
"""Longest time in s that the store may take to write a small file."""
_BLOCK = bytes(4096)

CheckName = Literal["database", "scheduler", "workers", "store", "disk"]


class Check(Record):
    """One thing that was tried."""

    name: CheckName
    ok: bool
    sentence: str = Field(description="what was found, and the remedy where it is bad")


class Readiness:
    """Tries everything that a job needs.

    Args:
        jobs_folder: where jobs are stored.
        is_running: returns whether queued jobs are run.
        free_bytes: returns the free disk space in bytes where jobs are stored.
        scheduler: address of the workers' scheduler; None where workers are the server's own.
        certificates: TLS certificates for the scheduler; None without TLS.
        workers: returns a sentence on how many workers can run stages, and raises where none can; None where jobs need
            none.
    """

    def __init__(
        self,
        engine: sql.Engine,
        jobs_folder: Path,
        is_running: Callable[[], bool],
        free_bytes: Callable[[], int],
        scheduler: str | None = None,
        certificates: Certificates | None = None,
        workers: Callable[[], str] | None = None,
    ) -> None:
        self._engine, self._jobs_folder = engine, jobs_folder
        self._is_running, self._free_bytes, self._address, self._certificates = (
            is_running,
            free_bytes,
            scheduler,
            certificates,
        )
        self._workers = workers or _no_workers
        self._file = _identity(engine)
        self._prober, self._store_prober = ThreadPoolExecutor(1, "readiness"), ThreadPoolExecutor(1, "store-readiness")

    def checks(self) -> tuple[Check, ...]:
        """Try everything; a check that fails is returned and does not raise."""
        tries: tuple[tuple[CheckName, Callable[[], str]], ...] = (
            ("database", self._database),
            ("scheduler", self._scheduler),
            ("workers", self._workers),
            ("store", self._store),
            ("disk", self._disk),
        )
        return tuple(_check(name, attempt) for name, attempt in tries)

    def _database(self) -> str:
        if _identity(self._engine) != self._file:
            raise StoreError(
                "The database file was removed or replaced while the server ran; stop the server, restore the file and"
                " start again."
            )
        writing_once = self._prober.submit(self._take_write_lock)
        try:
            writing_once.result(PROBE_S)
        except TimeoutError:
            writing_once.cancel()
            raise StoreError(
                f"The database grants no write within {PROBE_S:g} s; find the process that holds it locked and end it."
            ) from None
        except sql.exc.SQLAlchemyError as problem:
            raise StoreError(
                f"The database cannot be written ({_cause(problem)}); check its file, its folder and the disk."
            ) from problem
        return "The database can be read and written."

    def _take_write_lock(self) -> None:
        with writing(self._engine) as connection:
            connection.execute(sql.select(sql.func.max(event_table.c.id)))

    def _scheduler(self) -> str:
        if not self._is_running():
            raise PlatformError("Jobs are not being run; restart the server and read its log.")
        if self._address is not None:
            require_scheduler(self._address, self._certificates)
        return "Queued jobs are being run."

    def _store(self) -> str:
        writing_once = self._store_prober.submit(self._write_file)
        try:
            writing_once.result(STORE_PROBE_S)
        except TimeoutError:
            writing_once.cancel()
            raise StoreError(
                f"The jobs' folder takes no file within {STORE_PROBE_S:g} s; look at its disk, or at the network to it."
            ) from None
        except OSError as problem:
            raise StoreError(
                f"The jobs' folder cannot be written ({problem.strerror}); check its rights, its mount and the disk."
            ) from problem
        return "The jobs' folder can be written."

    def _write_file(self) -> None:
        probe = self._jobs_folder / f".probe-{secrets.token_hex(6)}"
        self._jobs_folder.mkdir(parents=True, exist_ok=True)
        try:
            with probe.open("wb") as stream:
                stream.write(_BLOCK)
                stream.flush()
                os.fsync(stream.fileno())
        finally:
            probe.unlink(missing_ok=True)

    def _disk(self) -> str:
        try:
            free_mib = self._free_bytes() // 2**20
        except OSError as problem:
            raise StoreError(
                f"The free space of the data folder cannot be read ({problem.strerror}); check that it exists."
            ) from problem
        needed_mib = KEPT_FREE_BYTES // 2**20
        if free_mib < needed_mib:
            raise StoreError(f"Only {free_mib} MiB of disk are free; free at least {needed_mib} MiB.")
        return f"{free_mib} MiB of disk are free."


def _no_workers() -> str:
    return "Jobs need no workers."


def _check(name: CheckName, attempt: Callable[[], str]) -> Check:
    try:
        return Check(name=name, ok=True, sentence=attempt())
    except DentineError as problem:
        return Check(name=name, ok=False, sentence=problem.message)


def _identity(engine: sql.Engine) -> tuple[int, int] | None:
    """Return the device and inode of a SQLite file; None where there is no file. They show that it was removed or
    replaced, which open connections would not notice.
    """
    if engine.dialect.name != "sqlite" or engine.url.database is None:
        return None
    try:
        stat = Path(engine.url.database).stat()
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def _cause(problem: sql.exc.SQLAlchemyError) -> str:
    """Return the message of the driver, without the statement and its values."""
    return str(getattr(problem, "orig", None) or type(problem).__name__)
