"""The worker processes that stages run in, kept from job to job: a local Dask cluster, or one that runs elsewhere."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

from services.core.errors import SchedulerLostError

if TYPE_CHECKING:
    from types import TracebackType

    from distributed import Client

WORKER_CONFIG: Mapping[str, Any] = MappingProxyType(
    {"distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"]}  # Ctrl-C is the parent's to handle
)
CONNECT_S = 10.0


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

    @contextmanager
    def client(self, count: int) -> Iterator[Client]:
        """A connection to ``count`` workers, all of them where they run elsewhere.

        Raises:
            SchedulerLostError: the scheduler does not answer.
        """
        with self._lock:
            if self._client is not None and self._client.status != "running":
                self._close()
            if self._client is None:
                self._open(count)
            elif self._cluster is not None:
                self._cluster.scale(count)
            client = self._client
        assert client is not None
        yield client

    def answers(self) -> bool:
        """Whether jobs could be given to workers: connected, or nothing to connect to yet."""
        client = self._client
        return self._scheduler is None or (client is not None and client.status == "running")

    def close(self) -> None:
        """End the processes, or leave those that run elsewhere."""
        with self._lock:
            self._close()

    def _open(self, count: int) -> None:
        import dask
        from distributed import Client, LocalCluster

        if self._scheduler is not None:
            try:
                self._client = Client(self._scheduler, timeout=CONNECT_S)
            except OSError as problem:
                raise SchedulerLostError(f"The scheduler {self._scheduler} does not answer; start it, the job waits.") from problem
            return
        with dask.config.set(WORKER_CONFIG):
            self._cluster = LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", resources={"DOME": 1}, silence_logs=50
            )
        self._client = Client(self._cluster)

    def _close(self) -> None:
        for one in (self._client, self._cluster):
            if one is not None:
                with suppress(OSError, TimeoutError):
                    one.close()
        self._client = self._cluster = None
