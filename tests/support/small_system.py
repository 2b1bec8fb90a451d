"""Database, scheduler, workers and API as processes of their own, each of which a test can kill and start again."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import psutil

from tests.support.live_server import connect
from tests.support.postgres import PostgresServer, new_database

ROOT = Path(__file__).parents[2]
PATIENCE_S = 300.0
"""A bound for a machine that is busy with something else."""


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class SmallSystem:
    """One of each, two workers, of which one may reach the dome."""

    def __init__(self, folder: Path, postgres: PostgresServer) -> None:
        self.data, self._folder, self._postgres = folder / "data", folder, postgres
        scheduler = f"tcp://127.0.0.1:{free_port()}"
        settings = {"data": str(self.data), "port": free_port(), "database": new_database(postgres, "small"), "scheduler": scheduler}
        self.address = f"http://127.0.0.1:{settings['port']}"
        dask = [sys.executable, "-m", "dask"]
        worker = [*dask, "worker", scheduler, "--nworkers", "1", "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder / "dask")]
        self._commands = {
            "scheduler": [*dask, "scheduler", "--host", "127.0.0.1", "--port", scheduler.rpartition(":")[2], "--no-dashboard"],
            "worker": worker,
            "rig": [*worker, "--resources", "DOME=1"],
            "api": [sys.executable, "-m", "tests.support.toy_server", json.dumps(settings)],
        }
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, *names: str) -> None:
        """Start parts that are down, all by default, and wait for the API's answer."""
        if "database" in names:
            self._postgres.start()
        self._launch(*(names or self._commands))
        self.wait_until(self._answers, "the API does not answer")

    def kill(self, name: str) -> None:
        """Kill -9 a part and everything that it started."""
        if name == "database":
            self._postgres.kill()
            return
        process = self._processes[name]
        for one in [*psutil.Process(process.pid).children(recursive=True), process]:
            with suppress(psutil.NoSuchProcess):
                one.kill()
        process.wait(PATIENCE_S)

    def pids(self, name: str) -> set[int]:
        """Processes of a part."""
        process = psutil.Process(self._processes[name].pid)
        return {process.pid, *(child.pid for child in process.children(recursive=True))}

    def close(self) -> None:
        """End everything."""
        for name, process in self._processes.items():
            if process.poll() is None:
                self.kill(name)

    def client(self) -> httpx.Client:
        """A client of the API."""
        return connect(self.address)

    def wait_until(self, condition: Callable[[], bool], complaint: str) -> None:
        """Wait for ``condition()``, starting again what ended by itself, as an orchestrator does."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self._launch(*self._commands)
            if time.monotonic() > deadline:
                raise AssertionError(f"{complaint}; see the logs in {self._folder}")
            time.sleep(0.05)

    def _launch(self, *names: str) -> None:
        for name in names:
            if name in self._commands and (name not in self._processes or self._processes[name].poll() is not None):
                with (self._folder / f"{name}.log").open("ab") as log:
                    self._processes[name] = subprocess.Popen(self._commands[name], cwd=ROOT, stdout=log, stderr=log, start_new_session=True)

    def _answers(self) -> bool:
        with suppress(httpx.TransportError), connect(self.address) as client:
            return client.get("/v1/health/live").status_code == 200
        return False


@contextmanager
def small_system(folder: Path) -> Iterator[SmallSystem]:
    """A running system, ended with the block."""
    from tests.support.postgres import postgres_server

    (folder / "data").mkdir(parents=True)
    os.environ.setdefault("PYTHONPATH", str(ROOT))
    with postgres_server() as postgres:
        system = SmallSystem(folder, postgres)
        try:
            system.start()
            yield system
        finally:
            system.close()
