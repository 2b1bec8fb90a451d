"""Database, scheduler, workers and API as processes of their own, each of which a test can kill and start again.

With root rights, each process can also be a host of its own on a network that can be cut, and the store a disk of its
own that can be full.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import psutil

from services.core.placement import STAGES, UNLIMITED
from services.core.store import write_atomic
from tests.support.live_server import connect
from tests.support.network import Network, network_of
from tests.support.postgres import PostgresServer, new_database
from tests.support.store_disk import StoreDisk, store_disk

ROOT = Path(__file__).parents[2]
DASK_TIMEOUTS = {"COMM__TIMEOUTS__TCP": "11s", "COMM__TIMEOUTS__CONNECT": "5s", "SCHEDULER__WORKER_TTL": "20s"}
"""Timeouts of Dask, short because tests wait for them. Dask's defaults are 30 s, 30 s and 5 min; 11 s is the least that
it accepts for the first."""
RUNS_STAGES = f"{STAGES}={UNLIMITED}"
"""Resource that lets a worker run stages. Workers here get it without the check that they can run stages, because the
tests' stages need no packages."""
PATIENCE_S = 300.0
"""Time limit of every wait, long enough for a busy machine."""


def free_port() -> int:
    """A loopback port that no process listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class SmallSystem:
    """A database, a scheduler, an API and two workers, one of which may reach the dome.

    Args:
        network: network whose hosts are the scheduler, the workers and the database; None to run all on this host.
        disk: disk that holds the data folder; None for an ordinary folder.
        has_rig_apart: the worker that reaches the dome only captures, and there is one more worker for the stages.
        stages: module with the stages that jobs run.
    """

    def __init__(
        self,
        folder: Path,
        postgres: PostgresServer,
        network: Network | None = None,
        disk: StoreDisk | None = None,
        *,
        has_rig_apart: bool = False,
        stages: str = "tests.support.toy_stages",
    ) -> None:
        self.data, self.network, self.disk, self._folder, self._postgres = (
            folder / "data",
            network,
            disk,
            folder,
            postgres,
        )
        self.acknowledged: list[str] = []

        def host(name: str) -> str:
            return network.address(name) if network else "127.0.0.1"

        def inside(name: str) -> list[str]:
            return network.inside(name) if network else []

        self.scheduler = scheduler = f"tcp://{host('scheduler')}:{free_port()}"
        settings = {
            "data": str(self.data),
            "port": free_port(),
            "database": new_database(postgres, "small"),
            "scheduler": scheduler,
        }
        self.address = f"http://127.0.0.1:{settings['port']}"
        dask = [sys.executable, "-m", "dask"]
        worker = [
            *dask,
            "worker",
            scheduler,
            "--nworkers",
            "1",
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            str(folder / "dask"),
        ]
        self._commands = {
            "scheduler": [
                *inside("scheduler"),
                *dask,
                "scheduler",
                "--host",
                host("scheduler"),
                "--port",
                scheduler.rpartition(":")[2],
                "--no-dashboard",
            ],
            "worker": [*inside("worker"), *worker, "--host", host("worker"), "--resources", RUNS_STAGES],
            "rig": [
                *inside("rig"),
                *worker,
                "--host",
                host("rig"),
                "--resources",
                "DOME=1" if has_rig_apart else f"{RUNS_STAGES} DOME=1",
            ],
            "api": [
                sys.executable,
                "-m",
                "tests.support.stepped_clock",
                str(self._clock_step),
                "tests.support.toy_server",
                json.dumps(settings),
                stages,
            ],
        }
        if has_rig_apart:
            self._commands["worker2"] = self._commands["worker"]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, *names: str) -> None:
        """Start the named parts that are down, by default all, and wait for the API's answer."""
        if "database" in names:
            self._postgres.start()
        self._launch(*(names or self._commands))
        self.wait_until(self._answers, "the API does not answer")

    def kill(self, name: str) -> None:
        """Kill a part and all its child processes by SIGKILL."""
        if name == "database":
            self._postgres.kill()
            return
        process = self._processes[name]
        for one in [*psutil.Process(process.pid).children(recursive=True), process]:
            with suppress(psutil.NoSuchProcess):
                one.kill()
        process.wait(PATIENCE_S)

    @contextmanager
    def without(self, *names: str) -> Iterator[None]:
        """Kill parts, and start them again after the block."""
        for name in names:
            self.kill(name)
        yield
        self.start(*names)

    def pids(self, name: str) -> set[int]:
        """Process ids of a part and its child processes."""
        process = psutil.Process(self._processes[name].pid)
        return {process.pid, *(child.pid for child in process.children(recursive=True))}

    def close(self) -> None:
        """Kill all parts that still run."""
        for name, process in self._processes.items():
            if process.poll() is None:
                self.kill(name)

    def step_clock(self, ahead_s: float) -> None:
        """Set the seconds by which the API's clock is ahead of the true one."""
        write_atomic(self._clock_step, str(ahead_s).encode())

    @property
    def _clock_step(self) -> Path:
        return self._folder / "clock-step"

    def client(self) -> httpx.Client:
        """A client of the API."""
        return connect(self.address)

    def wait_until(self, condition: Callable[[], bool], complaint: str) -> None:
        """Wait for ``condition()``. Parts that ended by themselves are started again, as an orchestrator does."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self._launch(*self._commands)
            if time.monotonic() > deadline:
                raise AssertionError(f"{complaint}; see the logs in {self._folder}")
            time.sleep(0.05)

    def _launch(self, *names: str) -> None:
        for name in names:
            if name in self._commands and (name not in self._processes or self._processes[name].poll() is not None):
                environment = os.environ | {
                    f"DASK_DISTRIBUTED__{option}": value for option, value in DASK_TIMEOUTS.items()
                }
                with (self._folder / f"{name}.log").open("ab") as log:
                    self._processes[name] = subprocess.Popen(
                        self._commands[name], cwd=ROOT, env=environment, stdout=log, stderr=log, start_new_session=True
                    )

    def _answers(self) -> bool:
        with suppress(httpx.TransportError), connect(self.address) as client:
            return client.get("/v1/health/live").status_code == 200
        return False


@contextmanager
def small_system(folder: Path, *, on_hosts: bool = False, **options: Any) -> Iterator[SmallSystem]:
    """Run a system for the time of the block.

    Args:
        on_hosts: make its parts hosts on a network and its store a disk; the test is skipped where this is not
            permitted.
        options: see ``SmallSystem``.
    """
    from tests.support.postgres import postgres_server

    os.environ.setdefault("PYTHONPATH", str(ROOT))
    with ExitStack() as stack:
        network, disk = None, None
        if on_hosts:
            network, disk = (
                stack.enter_context(network_of("scheduler", "worker", "rig", "database")),
                stack.enter_context(store_disk(folder / "data")),
            )
        system = SmallSystem(folder, stack.enter_context(postgres_server(network)), network, disk, **options)
        system.data.mkdir(parents=True, exist_ok=True)
        stack.callback(system.close)
        system.start()
        yield system
