"""The worker processes that stages run in, kept from job to job: a local Dask cluster, or one that runs elsewhere."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, Self
from urllib.parse import urlsplit

from services.core.errors import PlatformError, SchedulerLostError
from services.core.placement import DOME, STAGES, UNLIMITED
from services.pipeline.dask_config import DASK_CONFIG
from services.pipeline.dask_tls import Certificates, scheduler_address
from services.pipeline.garbage_collection import freeze_loaded_objects
from services.pipeline.worker_check import OwnCheck

if TYPE_CHECKING:
    from types import TracebackType

    from distributed import Client

SIGINT_IS_THE_PARENTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
CLOSE_HTTP = "services.pipeline.close_http"
CONNECT_S = 10.0
PROBE_S = 1.0
CENSUS_TIMEOUT_S = 3.0
"""Longest time, s, that the scheduler may take to answer about its workers."""


NOT_STARTED = "Workers start with the next job."
FAULT_KEY = "dentine"
"""Name under which a worker reports its faults to the scheduler."""
RIG = "rig"
"""Name of this process's own worker for captures."""


class Demand(NamedTuple):
    """The workers that a running job needs."""

    workers: int
    captures: bool


class Census(NamedTuple):
    """A scheduler's information on its workers, by their addresses."""

    workers: Mapping[str, Mapping[str, Any]]
    processing: Mapping[str, Sequence[Any]]
    """Keys of the tasks that each worker has been given."""

    def count_with(self, resource: str) -> int:
        """Number of workers that have a resource."""
        return sum(bool(worker["resources"].get(resource)) for worker in self.workers.values())

    def sentence(self, *, captures: bool = False) -> str:
        """A sentence on how many workers can run stages and can capture, or on why none can."""
        connected, stages = len(self.workers), self.count_with(STAGES)
        if captures and not self.count_with(DOME):
            return (
                f"None of the {connected} connected workers reaches a dome; start one with dentine worker"
                " --captures-only."
            )
        if stages or captures:
            rigs = self.count_with(DOME)
            return f"{stages} worker{'' if stages == 1 else 's'} can run stages, {rigs} can capture."
        if not connected:
            return "The scheduler has no workers; start some with dentine worker."
        why = sorted({str(fault) for worker in self.workers.values() if (fault := worker.get(FAULT_KEY))})
        what = f"None of the {connected} connected workers can run stages"
        return f"{what}: {' '.join(why)}" if why else f"{what}; start some with dentine worker."


class Workers:
    """The workers of this process's jobs, started with the first job and again after they broke; a context manager.

    Args:
        scheduler: address of a Dask scheduler; None for workers of this process's own, on loopback, with one thread
            each. Where a job captures, one worker more than the jobs ask for is started, so that no capture waits for a
            fit or is stopped with it.
        certificates: certificates to show to that scheduler; None for connections without TLS.
    """

    def __init__(self, scheduler: str | None = None, certificates: Certificates | None = None) -> None:
        self._scheduler, self._certificates = scheduler and scheduler_address(scheduler, certificates), certificates
        self._lock = threading.Lock()
        self._cluster: Any = None
        self._client: Client | None = None
        self._demands: list[Demand] = []
        self._own_check: OwnCheck | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def serving(self, count: int, *, captures: bool = False) -> Iterator[Client]:
        """A connection to at least ``count`` workers for one job, or to all workers where they run elsewhere.

        Jobs that run at once share as many workers as the largest of their demands.

        Raises:
            SchedulerLostError: the scheduler does not answer.
        """
        demand = Demand(count, captures)
        with self._lock:
            self._demands.append(demand)
        try:
            yield self.connect()
        finally:
            with self._lock:
                self._demands.remove(demand)

    def connect(self) -> Client:
        """The connection to the scheduler, which this object owns and closes.

        Raises:
            SchedulerLostError: the scheduler does not answer.
        """
        with self._lock:
            if self._client is not None and self._client.status != "running":
                self._close()
            if self._client is None:
                self._client = self._open()
            self._scale()
            return self._client

    def restart_lost(self) -> None:
        """Start lost workers again; Dask gives up a worker that does not come back within 15 s."""
        with self._lock:
            self._scale()

    def census(self) -> Census | None:
        """The present workers and their tasks; None where this process has workers of its own that no job has started
        yet.

        Raises:
            SchedulerLostError: the scheduler does not answer.
        """
        client = self._client  # read without the lock, which a thread that starts workers holds for seconds
        if client is None or client.status != "running":
            if self._scheduler is None:
                return None
            require_scheduler(self._scheduler, self._certificates)
            client = self.connect()
        try:
            census: Census = client.sync(_census, client, callback_timeout=CENSUS_TIMEOUT_S)
        except (OSError, TimeoutError) as problem:
            raise SchedulerLostError(
                f"The scheduler {self._scheduler or 'of this server'} does not answer; jobs wait for it."
            ) from problem
        return census

    def reason_unavailable(self, captures: bool) -> str | None:
        """Why no worker can capture, or run other stages; None if one can, or if this process starts its own."""
        if self._scheduler is None:
            return None
        try:
            census = self.census()
        except SchedulerLostError as problem:
            return problem.message
        return (
            None
            if census is None or census.count_with(DOME if captures else STAGES)
            else census.sentence(captures=captures)
        )

    def condition(self) -> str:
        """A sentence on how many workers can run stages.

        Raises:
            PlatformError: none can. SchedulerLostError: their scheduler does not answer.
        """
        if self._own_check is not None:
            return self._own_check.condition()
        census = self.census()
        if census is None:
            return NOT_STARTED
        if not census.count_with(STAGES):
            raise PlatformError(census.sentence())
        return census.sentence()

    def begin_check(self) -> None:
        """Check in the background whether this process's own workers can run stages; ``condition`` gives the result."""
        if self._scheduler is None:
            self._own_check = OwnCheck()

    def close(self) -> None:
        """End this process's own workers, or close the connection to workers that run elsewhere."""
        with self._lock:
            self._close()

    def _scale(self) -> None:
        if self._cluster is None or not self._demands:
            return
        specs, target_count = self._cluster.worker_spec, max(demand.workers for demand in self._demands)
        if RIG not in specs and any(demand.captures for demand in self._demands):
            (fresh,) = self._cluster.new_worker_spec().values()
            rig = fresh | {"options": fresh["options"] | {"resources": {DOME: 1}}}
            others = dict(specs)
            specs.clear()
            specs.update({RIG: rig} | others)  # first, because scaling down removes the last workers
        extra = int(RIG in specs)
        if len(self._demands) > 1:  # a worker that this job does not need may hold tasks of another
            target_count = max(target_count, len(specs) - extra)
        self._cluster.scale(target_count + extra)

    def _open(self) -> Client:
        import dask
        from distributed import Client, LocalCluster

        from services.pipeline.dask_security import LastingSecurity

        _freeze_loaded_objects_once()
        # The configuration is set for good, and in this process too, because later connections read it.
        preloads = {
            "distributed.worker.preload": [SIGINT_IS_THE_PARENTS, CLOSE_HTTP],
            "distributed.scheduler.preload": [CLOSE_HTTP],
        }
        dask.config.set({**DASK_CONFIG, **preloads})
        if self._scheduler is not None:
            try:
                security = self._certificates.security() if self._certificates else None
                return Client(self._scheduler, timeout=CONNECT_S, security=security)
            except OSError as problem:
                raise SchedulerLostError(
                    f"The scheduler {self._scheduler} does not answer; start it, the job waits."
                ) from problem
        # Loopback is open to every user of the machine, so workers there show certificates too, which are made here and
        # kept in memory.
        self._cluster = LocalCluster(
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            security=LastingSecurity.temporary(),
            dashboard_address="127.0.0.1:0",
            resources={STAGES: UNLIMITED},
            silence_logs=50,
        )
        return Client(self._cluster)

    def _close(self) -> None:
        for one in (self._client, self._cluster):
            if one is not None:
                with suppress(OSError, TimeoutError):
                    one.close()
        self._client = self._cluster = None


@cache
def _freeze_loaded_objects_once() -> None:
    # This is done once in a process, because anything else that is frozen, such as the remains of a failed connection,
    # is never collected.
    freeze_loaded_objects()


async def _census(client: Client) -> Census:
    identity = await client.scheduler.identity(n_workers=-1)
    return Census(identity["workers"], await client.scheduler.processing(workers=None))


def require_scheduler(address: str, certificates: Certificates | None = None) -> None:
    """Check that a scheduler answers: it greets every peer that connects, and with TLS only those that it trusts.

    Args:
        address: ``tcp://HOST:PORT``
        certificates: certificates to show to it; None without TLS.

    Raises:
        SchedulerLostError: no scheduler answers there.
    """
    parts = urlsplit(address)
    try:
        with (
            socket.create_connection((parts.hostname, parts.port), PROBE_S) as plain,
            certificates.context().wrap_socket(plain) if certificates else nullcontext(plain) as connection,
        ):
            is_greeted = connection.recv(1) != b""
    except ssl.SSLError as problem:
        what = f"The scheduler {address} and this server do not trust each other ({problem.reason})"
        raise SchedulerLostError(f"{what}; give both certificates of one authority, jobs wait for it.") from problem
    except (OSError, ValueError) as problem:
        raise SchedulerLostError(f"The scheduler {address} does not answer; start it, jobs wait for it.") from problem
    if not is_greeted:
        raise SchedulerLostError(f"The scheduler {address} does not answer; start it, jobs wait for it.")
