"""Faults that strike while a job is held at one point of one stage.

Each fault is a context manager. It strikes when the context is entered. The block lets the job continue; afterwards the
context checks the system from outside while the fault lasts, and finally mends it.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import httpx

from tests.support.network import HERE
from tests.support.small_system import SmallSystem
from tests.support.store_disk import read_only

OUTLASTED_S = 16.0
"""Time longer than the lease and Dask's timeouts in the small system."""
CLOCK_STEP_S = 3600.0
TWINS = 8
ENDED = frozenset({"SUCCEEDED", "FAILED", "CANCELLED"})


@dataclass(frozen=True)
class Held:
    """A job that waits at a point at which a stage holds it."""

    system: SmallSystem
    job: str
    key: str
    """Idempotency key under which it was submitted."""
    spec: Mapping[str, Any]
    stage: str
    reached: Path
    """File with the id of the process that runs the stage."""
    pid: int
    """Id of that process when the job was held."""

    @property
    def host(self) -> str:
        """Name of the part that runs the process ``pid``: ``worker`` or ``rig``."""
        return next(name for name in ("worker", "rig") if self.pid in self.system.pids(name))

    def get(self, path: str) -> Any:
        """The API's JSON answer for a path; an empty mapping while the API does not answer."""
        with suppress(httpx.TransportError), self.system.client() as client:
            return client.get(path).json()
        return {}

    def ended(self) -> bool:
        """Whether the job has ended."""
        return self.get(f"/v1/jobs/{self.job}").get("state") in ENDED

    def submit(self, **changes: Any) -> httpx.Response:
        """Submit the job again under the same key, with changed fields if any are given."""
        with self.system.client() as client:
            return client.post("/v1/jobs", json={**self.spec, **changes}, headers={"Idempotency-Key": self.key})

    def outlast(self, seconds: float = OUTLASTED_S) -> None:
        """Let some time pass; parts that end meanwhile are started again."""
        until = time.monotonic() + seconds
        self.system.wait_until(lambda: time.monotonic() > until, "time stands still")

    def require_pause(self, what: str) -> None:
        """Wait until the API states that the job waits for ``what``."""
        self.system.wait_until(
            lambda: str(self.get(f"/v1/jobs/{self.job}").get("waits_for")).startswith(f"Waits for {what}: "),
            f"job {self.job} does not wait for {what}",
        )

    def require_bad(self, *parts: str) -> None:
        """Wait until the readiness route names exactly these parts as bad."""

        def bad() -> set[str]:
            return {check["name"] for check in self.get("/v1/health/ready").get("checks", ()) if not check["ok"]}

        self.system.wait_until(lambda: bad() == set(parts), f"readiness does not name {parts} as bad")


Fault = Callable[[Held], AbstractContextManager[None]]


@contextmanager
def killed(part: str, held: Held) -> Iterator[None]:
    """Kill a part by SIGKILL, and start it again as an orchestrator does."""
    if part == "stage":
        os.kill(held.pid, signal.SIGKILL)
    else:
        held.system.kill(held.host if part == "host" else part)
    held.system.start(*(("database",) if part == "database" else ()))
    yield


@contextmanager
def worker_cut_off(held: Held) -> Iterator[None]:
    """Cut the stage's host from the scheduler. It stays cut until another host has begun the same stage; then both go
    on, because the lost host still reaches database and store.

    No other host can take over a capture, which goes on alone.
    """
    host = held.host
    with _cut(held, host, "scheduler"):
        if held.stage == "capture":
            held.outlast()
        else:
            held.system.wait_until(
                lambda: held.reached.read_text() not in {"", str(held.pid)}, f"nobody else began stage {held.stage}"
            )
        yield


@contextmanager
def api_without_scheduler(held: Held) -> Iterator[None]:
    """Cut the API from the scheduler; the workers go on."""
    with _cut(held, HERE, "scheduler"):
        yield
        held.outlast()
        held.require_bad("scheduler", "workers")  # without the scheduler, the API has no workers


@contextmanager
def api_without_database(held: Held) -> Iterator[None]:
    """Cut the API from the database; the workers go on."""
    with _cut(held, HERE, "database"):
        yield
        held.outlast()
        held.require_bad("database")


@contextmanager
def full_disk(held: Held) -> Iterator[None]:
    """Leave no free block on the disk; the job must pause and state the reason."""
    assert held.system.disk is not None
    with held.system.disk.full():
        yield
        held.require_pause("disk")
        held.require_bad("store", "disk")


@contextmanager
def read_only_store(held: Held) -> Iterator[None]:
    """Make the jobs' folder read-only; the job must pause and state the reason."""
    with read_only(held.system.data / "jobs"):
        yield
        held.require_pause("store")
        held.require_bad("store")


@contextmanager
def frozen_store(held: Held) -> Iterator[None]:
    """Make every write hang; the API must answer and name the store as bad."""
    assert held.system.disk is not None
    with held.system.disk.frozen():
        yield
        held.outlast()
        held.require_bad("store")
        assert not held.ended()


@contextmanager
def clock_ahead(held: Held) -> Iterator[None]:
    """Step the API's clock an hour ahead and, after the job has ended, back."""
    held.system.step_clock(CLOCK_STEP_S)
    yield
    held.system.wait_until(held.ended, f"job {held.job} did not end after the clock stepped ahead")
    held.system.step_clock(0.0)


@contextmanager
def clock_back(held: Held) -> Iterator[None]:
    """Kill the API and start it again with its clock an hour behind, so that its old lease ends far in the future."""
    held.system.kill("api")
    held.system.step_clock(-CLOCK_STEP_S)
    held.system.start()
    yield
    held.system.wait_until(held.ended, f"job {held.job} did not end after the clock stepped back")
    held.system.step_clock(0.0)


@contextmanager
def submitted_again(held: Held) -> Iterator[None]:
    """Repeat the submission several times at once, and submit a different job under the same key."""
    with ThreadPoolExecutor(TWINS) as together:
        answers = [answer.result() for answer in [together.submit(held.submit) for _ in range(TWINS)]]
    assert {(answer.status_code, answer.json()["id"]) for answer in answers} == {(200, held.job)}
    assert held.submit(workers=2).status_code == 409
    yield


FAULTS: Mapping[str, Fault] = MappingProxyType(
    {part: partial(killed, part) for part in ("api", "scheduler", "stage", "host", "database")}
    | {
        "worker cut off": worker_cut_off,
        "api without scheduler": api_without_scheduler,
        "api without database": api_without_database,
        "disk full": full_disk,
        "store read-only": read_only_store,
        "store frozen": frozen_store,
        "clock ahead": clock_ahead,
        "clock back": clock_back,
        "submitted again": submitted_again,
    }
)


@contextmanager
def _cut(held: Held, one: str, other: str) -> Iterator[None]:
    assert held.system.network is not None
    held.system.network.cut(one, other)
    try:
        yield
    finally:
        held.system.network.heal(one, other)
