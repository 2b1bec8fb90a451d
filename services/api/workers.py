"""The worker processes that stages run in, kept from job to job: a local Dask cluster, or one that runs elsewhere."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, Self
from urllib.parse import urlsplit

from services.api.collector import leave_alone_what_is_loaded
from services.api.dask_tls import Certificates, scheduler_address
from services.core.dask_config import DASK_CONFIG
from services.core.errors import SchedulerLostError

if TYPE_CHECKING:
    from types import TracebackType

    from distributed import Client

SIGINT_IS_THE_PARENTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
CONNECT_S = 10.0
PROBE_S = 1.0
LOOK_S = 3.0
"""How long the scheduler may take to tell of its workers."""


class Census(NamedTuple):
    """What a scheduler tells of its workers, each by its address."""

    workers: Mapping[str, Mapping[str, Any]]
    processing: Mapping[str, Sequence[Any]]
    """Keys of the tasks that each has been given."""


class Workers:
    """Opened at the first job and again after they broke; a context manager.

    Args:
        scheduler: address of a Dask scheduler; None for workers of this process's own, on loopback, one thread each. Any of those may reach the dome, one
            stage at a time.
        certificates: what to show that scheduler; None for connections without TLS.
    """

    def __init__(self, scheduler: str | None = None, certificates: Certificates | None = None) -> None:
        self._scheduler, self._certificates = scheduler and scheduler_address(scheduler, certificates), certificates
        self._lock = threading.Lock()
        self._cluster: Any = None
        self._client: Client | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def connect(self, count: int) -> Client:
        """A connection to ``count`` workers, or to all where they run elsewhere; it stays this object's.

        Raises:
            SchedulerLostError: the scheduler does not answer.
        """
        with self._lock:
            if self._client is not None and self._client.status != "running":
                self._close()
            if self._client is None:
                self._client = self._open(count)
            elif self._cluster is not None:
                self._cluster.scale(count)
            return self._client

    def keep(self, count: int) -> None:
        """Start again what was lost of ``count`` workers: Dask gives up one that does not come back within 15 s, as on a busy machine."""
        with self._lock:
            if self._cluster is not None:
                self._cluster.scale(count)

    def look(self) -> Census | None:
        """Who works on what by now; None where workers of this process's own have not been started yet, as the first job does that.

        Raises:
            SchedulerLostError: the scheduler does not answer.
        """
        client = self._client  # without the lock, which whoever starts workers holds for seconds
        if client is None or client.status != "running":
            if self._scheduler is None:
                return None
            require_scheduler(self._scheduler, self._certificates)
            client = self.connect(0)
        try:
            census: Census = client.sync(_census, client, callback_timeout=LOOK_S)
        except (OSError, TimeoutError) as problem:
            raise SchedulerLostError(f"The scheduler {self._scheduler or 'of this server'} does not answer; jobs wait for it.") from problem
        return census

    def close(self) -> None:
        """End the processes, or leave those that run elsewhere."""
        with self._lock:
            self._close()

    def _open(self, count: int) -> Client:
        import dask
        from distributed import Client, LocalCluster

        _leave_dask_alone()
        # For good, and in this process too, as connections that are made later read it.
        dask.config.set({**DASK_CONFIG, "distributed.worker.preload": [SIGINT_IS_THE_PARENTS]})
        if self._scheduler is not None:
            try:
                security = self._certificates.security() if self._certificates else None
                return Client(self._scheduler, timeout=CONNECT_S, security=security)
            except OSError as problem:
                raise SchedulerLostError(f"The scheduler {self._scheduler} does not answer; start it, the job waits.") from problem
        self._cluster = LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", resources={"DOME": 1}, silence_logs=50
        )
        return Client(self._cluster)

    def _close(self) -> None:
        for one in (self._client, self._cluster):
            if one is not None:
                with suppress(OSError, TimeoutError):
                    one.close()
        self._client = self._cluster = None


@cache
def _leave_dask_alone() -> None:
    # Once in a process: whatever else is frozen, such as what a connection that failed has left, is never collected.
    leave_alone_what_is_loaded()


async def _census(client: Client) -> Census:
    identity = await client.scheduler.identity(n_workers=-1)
    return Census(identity["workers"], await client.scheduler.processing(workers=None))


def require_scheduler(address: str, certificates: Certificates | None = None) -> None:
    """Look whether a scheduler answers: it greets whoever connects, and by TLS only whom it trusts.

    Args:
        address: ``tcp://HOST:PORT``
        certificates: what to show it; None without TLS.

    Raises:
        SchedulerLostError: nobody answers there.
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
