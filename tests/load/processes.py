"""Servers as processes of their own, and their memory."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).parents[2]
PATIENCE_S = 300.0
"""A bound for a machine that is busy with something else."""


@dataclass(frozen=True)
class Served:
    """A running server."""

    address: str
    process: psutil.Process
    data: Path
    headers: dict[str, str]

    def memory_bytes(self) -> tuple[int, int]:
        """Resident and proportional size of the server's own process."""
        memory = self.process.memory_full_info()
        return memory.rss, memory.pss

    def workers_bytes(self) -> int:
        """Proportional size of every process that it has started."""
        size = 0
        for child in self.process.children(recursive=True):
            with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                size += child.memory_full_info().pss
        return size

    def cpu_s(self) -> float:
        """Processor time of the server's own process."""
        times = self.process.cpu_times()
        return float(times.user + times.system)


@contextmanager
def serving(data: Path, token: str | None = None, **settings: Any) -> Iterator[Served]:
    """The shipped server with toy stages on a data folder; ``token`` is sent with every request."""
    access = {} if token is None else {"access": "tokens", "job_roots": "/"}
    command = [
        sys.executable,
        "-m",
        "tests.load.server",
        json.dumps({"data": str(data), "port": 0} | access | settings),
    ]
    with _running(command, data, {} if token is None else {"Authorization": f"Bearer {token}"}) as served:
        yield served


@contextmanager
def serving_bare(data: Path, database: Path) -> Iterator[Served]:
    """The peer: one FastAPI route that reads one row."""
    with _running([sys.executable, "-m", "tests.load.bare_server", str(database)], data, {}) as served:
        yield served


@contextmanager
def _running(command: list[str], data: Path, headers: dict[str, str]) -> Iterator[Served]:
    data.mkdir(parents=True, exist_ok=True)
    with (
        (data / "server.log").open("w") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=ROOT) as process,
    ):
        try:
            assert process.stdout is not None
            yield Served(process.stdout.readline().strip(), psutil.Process(process.pid), data, headers)
        finally:
            process.terminate()
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
