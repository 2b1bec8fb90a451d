"""The worker processes that stages run in, kept from job to job: a local Dask cluster, or one that runs elsewhere."""

from __future__ import annotations

import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urlsplit

from services.core.errors import SchedulerLostError

if TYPE_CHECKING:
    from types import TracebackType

    from distributed import Client

WORKER_CONFIG: Mapping[str, Any] = MappingProxyType(
    {"distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"]}  # Ctrl-C is the parent's to handle
)
CONNECT_S = 10.0
PROBE_S = 1.0


class Workers:
    """Opened at the first job and again after they broke; a context manager.

    Args:
        scheduler: address of a Dask scheduler; None for workers of this process's own, on loopback, one thread each. Any of those may reach the dome, one
            stage at a time.
    """

    def __init__(self, scheduler: str | None = None) -> None:
        self._scheduler = scheduler
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

    def close(self) -> None:
        """End the processes, or leave those that run elsewhere."""
        with self._lock:
            self._close()

    def _open(self, count: int) -> Client:
        import dask
        from distributed import Client, LocalCluster

        if self._scheduler is not None:
            try:
                return Client(self._scheduler, timeout=CONNECT_S)
            except OSError as problem:
                raise SchedulerLostError(f"The scheduler {self._scheduler} does not answer; start it, the job waits.") from problem
        with dask.config.set(WORKER_CONFIG):
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


def require_scheduler(address: str) -> None:
    """Look whether a scheduler answers: it greets whoever connects.

    Args:
        address: ``tcp://HOST:PORT``

    Raises:
        SchedulerLostError: nobody answers there.
    """
    parts = urlsplit(address)
    try:
        with socket.create_connection((parts.hostname, parts.port), PROBE_S) as connection:
            is_greeted = parts.scheme != "tcp" or connection.recv(1) != b""  # TLS waits for the client's word
    except (OSError, ValueError) as problem:
        raise SchedulerLostError(f"The scheduler {address} does not answer; start it, jobs wait for it.") from problem
    if not is_greeted:
        raise SchedulerLostError(f"The scheduler {address} does not answer; start it, jobs wait for it.")
