"""Executors for the blocks of a preparation: the workers of the Dask cluster if this code runs as a Dask task, else
this process, one block after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Protocol, TypeVar

from services.core.placement import rank
from services.core.records import Priority

WATCH_S = 0.25
"""Interval in s at which a preparation that waits for its blocks looks for a cancel."""

B = TypeVar("B", bound=Callable[[], Any])


class Executor(Protocol):
    """Executor of blocks that do not depend on each other."""

    threads: int
    """Number of blocks that run at once."""

    def run(self, blocks: Sequence[B]) -> Iterator[B]:
        """Yield each block once it has ended.

        An exception of a block is raised here; blocks that have not begun by then never run.
        """


class LocalExecutor:
    """Executor in this process; it runs each block when the caller asks for the next one."""

    threads = 1

    def run(self, blocks: Sequence[B]) -> Iterator[B]:
        """See ``Executor``."""
        for block in blocks:
            block()
            yield block


class DaskExecutor:
    """Executor on the workers that may run the surrounding Dask task.

    Args:
        client: Dask client.
        key: key of the surrounding task; the blocks' keys begin with it, which shows to which task they belong.
        resources: Dask resources that a worker must have to run the blocks.
        priority: priority of the job.
        raise_if_cancelled: raises an error once the job was cancelled. It is called while blocks are awaited, because
            they may wait behind long tasks of other jobs.
    """

    def __init__(
        self,
        client: Any,
        key: str,
        resources: dict[str, float],
        priority: Priority,
        raise_if_cancelled: Callable[[], None],
    ) -> None:
        self._client, self._key, self._resources, self._priority = client, key, resources, -rank(priority)
        self._submitted, self._raise_if_cancelled = 0, raise_if_cancelled
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        thread_counts = [
            int(worker["nthreads"])
            for worker in workers
            if all(worker["resources"].get(name, 0) >= amount for name, amount in resources.items())
        ]
        self.threads = max(1, sum(thread_counts))

    def run(self, blocks: Sequence[B]) -> Iterator[B]:
        """See ``Executor``. A block whose worker dies runs again on another worker."""
        from distributed import wait

        pending = {}
        for block in blocks:
            self._submitted += 1
            future = self._client.submit(
                block,
                key=f"{self._key}-block-{self._submitted}",
                resources=self._resources,
                priority=self._priority,
                pure=False,
            )
            pending[future] = block
        try:
            while pending:
                self._raise_if_cancelled()
                ended = ()
                with suppress(TimeoutError):
                    ended = wait(list(pending), WATCH_S, return_when="FIRST_COMPLETED").done
                for future in ended:
                    future.result()
                    yield pending.pop(future)
        finally:
            if pending:
                self._client.cancel(list(pending))


def local_threads() -> int:
    """Number of blocks that may run in this process at once and share its memory: its Dask worker's threads, or 1."""
    from distributed import get_worker

    try:
        return max(1, int(get_worker().state.nthreads))
    except ValueError:
        return 1


@contextmanager
def open_executor(priority: Priority, raise_if_cancelled: Callable[[], None]) -> Iterator[Executor]:
    """Give the executor for blocks: inside a Dask task its cluster, elsewhere this process.

    The Dask task occupies no worker thread while it waits for its blocks.
    """
    from distributed import get_worker, worker_client

    try:
        worker = get_worker()
    except ValueError:
        yield LocalExecutor()
        return
    key = worker.get_current_task()
    resources = dict(worker.state.tasks[key].resource_restrictions or {})
    with worker_client() as client:
        yield DaskExecutor(client, str(key), resources, priority, raise_if_cancelled)
