"""Where the blocks of a preparation run: on the workers of the Dask cluster that this code is a task of, else here, one
after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from services.core.placement import rank
from services.core.records import Priority

B = TypeVar("B", bound=Callable[[], Any])


class Spread(Protocol):
    """Runs blocks that wait for no other."""

    threads: int
    """How many run at once."""

    def run(self, blocks: Sequence[B]) -> Iterator[B]:
        """Each block once it has ended. Raises what a block raised; those that have not begun then never do."""


class Here:
    """Runs each block when its end is asked for."""

    threads = 1

    def run(self, blocks: Sequence[B]) -> Iterator[B]:
        """See Spread."""
        for block in blocks:
            block()
            yield block


class OnWorkers:
    """Runs blocks on the workers that the surrounding task may run on.

    Args:
        key: of the surrounding task; the blocks' begin with it, which tells whose they are.
        needs: Dask resources of a worker that may run them.
    """

    def __init__(self, client: Any, key: str, needs: dict[str, float], priority: Priority) -> None:
        self._client, self._key, self._needs, self._priority = client, key, needs, -rank(priority)
        self._submitted = 0
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        able = [
            int(worker["nthreads"])
            for worker in workers
            if all(worker["resources"].get(name, 0) >= amount for name, amount in needs.items())
        ]
        self.threads = max(1, sum(able))

    def run(self, blocks: Sequence[B]) -> Iterator[B]:
        """See Spread. A block whose worker dies runs again on another."""
        from distributed import as_completed

        pending = {}
        for block in blocks:
            self._submitted += 1
            future = self._client.submit(
                block,
                key=f"{self._key}-block-{self._submitted}",
                resources=self._needs,
                priority=self._priority,
                pure=False,
            )
            pending[future] = block
        try:
            for future in as_completed(list(pending), loop=self._client.loop):
                future.result()
                yield pending.pop(future)
        finally:
            if pending:
                self._client.cancel(list(pending))


def threads_here() -> int:
    """How many blocks this process may run at once, and share its memory among: as many as its worker has threads."""
    from distributed import get_worker

    try:
        return max(1, int(get_worker().state.nthreads))
    except ValueError:
        return 1


@contextmanager
def spread(priority: Priority) -> Iterator[Spread]:
    """Inside a Dask task its cluster, holding no thread meanwhile; elsewhere this process."""
    from distributed import get_worker, worker_client

    try:
        worker = get_worker()
    except ValueError:
        yield Here()
        return
    key = worker.get_current_task()
    needs = dict(worker.state.tasks[key].resource_restrictions or {})
    with worker_client() as client:
        yield OnWorkers(client, str(key), needs, priority)
