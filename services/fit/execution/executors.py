"""Where tasks run: here, one after the other, or on the workers of a Dask cluster.

A task is ``task(host, *args)``; arguments may be earlier results.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from distributed import WorkerPlugin

from services.fit.execution.engine_host import ENGINE, CancellableHost, ChildHost, EngineHost, InProcessHost
from services.fit.execution.fair_shares import Board, Share

Task = Callable[..., Any]
Call = tuple[str, Task, tuple[Any, ...]]
"""What ``submit`` takes: a key, a task and its arguments."""
TASKS_AHEAD = 2
"""Tasks of a fit that are with the workers at once, for each of their threads: one that runs and one that follows at
once."""


class Executor(Protocol):
    """Runs tasks."""

    def submit(self, key: str, task: Task, *args: Any) -> Any:
        """Start ``task(host, *args)``; returns something that later submits and ``gather`` take."""

    def gather(self, pending: Sequence[Any]) -> list[Any]:
        """Results in the order given. Raises what a task raised."""

    def as_they_end(self, calls: Sequence[Call]) -> Iterator[Any]:
        """Run tasks that wait for no other, and give the result of each as soon as it is there.

        Raises what a task raised.
        """

    def threads(self, expected: int = 1) -> int:
        """How many tasks can run at once, where so many workers were asked for and some may still be starting."""


class LocalExecutor:
    """Runs each task when it is submitted, in this process or in a child of it."""

    def __init__(self, host: EngineHost) -> None:
        self._host = host

    def submit(self, key: str, task: Task, *args: Any) -> Any:  # noqa: ARG002 - keys name tasks on a cluster
        """See Executor."""
        return task(self._host, *args)

    def gather(self, pending: Sequence[Any]) -> list[Any]:
        """See Executor."""
        return list(pending)

    def as_they_end(self, calls: Sequence[Call]) -> Iterator[Any]:
        """See Executor; one after the other."""
        for key, task, args in calls:
            yield self.submit(key, task, *args)

    def threads(self, expected: int = 1) -> int:  # noqa: ARG002 - this process is alone
        """See Executor."""
        return 1


class DaskExecutor:
    """Runs tasks on any worker that has what they need; a worker's tasks share its one child process.

    Few tasks are with the workers at a time, so that those of another fit come in between; see ``shares``.

    Args:
        needs: Dask resources of a worker that may run the tasks.
        share: what this fit has used of the workers.
    """

    def __init__(
        self,
        client: Any,
        factory: str,
        prefix: str,
        flag: Path,
        needs: Mapping[str, float] | None = None,
        share: Share | None = None,
    ) -> None:
        from distributed import as_completed

        self._client, self._factory, self._prefix, self._submitted = client, factory, prefix, itertools.count()
        self._flag, self._needs, self._share = flag, dict(needs or {}), share or Share()
        self._board = Board(client, prefix, self._share)
        self._board.join()
        self._waiting: deque[_Planned] = deque()
        self._flying: dict[Any, _Planned] = {}
        self._ended = as_completed(loop=client.loop)

    def submit(self, key: str, task: Task, *args: Any) -> _Planned:
        """See Executor. Dask answers for a key that it still knows with the old result, so each task has its own.

        A task whose worker dies runs again elsewhere; what a task raises is final, as the same seeds would raise it
        again.
        """
        planned = _Planned(f"{self._prefix}-{next(self._submitted)}-{key}", task, args)
        self._waiting.append(planned)
        return planned

    def gather(self, pending: Sequence[_Planned]) -> list[Any]:
        """See Executor."""
        for _ in self._ending(pending):
            pass
        return [planned.timed.value for planned in pending]

    def as_they_end(self, calls: Sequence[Call]) -> Iterator[Any]:
        """See Executor."""
        for planned in self._ending([self.submit(key, task, *args) for key, task, args in calls]):
            yield planned.timed.value

    def _ending(self, pending: Sequence[_Planned]) -> Iterator[_Planned]:
        """Tasks as they end; meanwhile those that wait are sent."""
        most, missing = TASKS_AHEAD * self.threads(), set(pending)
        while missing:
            while self._waiting and len(self._flying) < most:
                self._send(self._waiting.popleft())
            self._board.tell()
            for future in self._ended.next_batch():
                planned = self._flying.pop(future)
                if future.status != "finished":
                    future.result()  # raises
                if planned in missing:  # else its result goes to another task, which counts its time
                    missing.remove(planned)
                    planned.timed = future.result()
                    self._share.end(planned.timed.seconds, planned.timed.tasks)
                    yield planned

    def close(self) -> None:
        """This fit needs the workers no more."""
        self._board.leave()

    def _send(self, planned: _Planned) -> None:
        # What an earlier task returns goes from worker to worker.
        args = [arg.future if isinstance(arg, _Planned) else arg for arg in planned.args]
        options = {"resources": self._needs, "priority": self._share.begin(), "key": planned.key, "pure": False}
        planned.future = self._client.submit(run_on_worker, self._factory, self._flag, planned.task, *args, **options)
        planned.args = ()
        self._flying[planned.future] = planned
        self._ended.add(planned.future)

    def threads(self, expected: int = 1) -> int:
        """See Executor."""
        able = self._client.scheduler_info(n_workers=-1)["workers"].values()
        there = sum(
            int(worker["nthreads"])
            for worker in able
            if all(worker["resources"].get(name, 0) >= amount for name, amount in self._needs.items())
        )
        return max(there, expected)


@dataclass(eq=False)
class _Planned:
    """A task of a fit, before and after it has been given to the workers."""

    key: str
    task: Task
    args: tuple[Any, ...]
    future: Any = None
    timed: Any = None


class Timed(NamedTuple):
    """What a task returned, and the worker time that went into it."""

    value: Any
    seconds: float
    """Of this task and of those whose results it took that were not counted themselves."""
    tasks: int


class _EnginePlugin(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """A worker's child process, made at its first task and ended with the worker."""

    def __init__(self, factory: str) -> None:
        self._factory = factory

    def setup(self, worker: Any) -> None:
        """Called by Dask when it is added to a worker."""
        self.host = ChildHost(self._factory, worker.state.nthreads, worker.memory_manager.memory_limit)

    def teardown(self, worker: Any) -> None:  # noqa: ARG002 - Dask's signature
        """Called by Dask when the worker closes."""
        self.host.close()


async def _prepare_worker(worker: Any, factory: str) -> _EnginePlugin:
    """The plugin of an engine, made on the worker's loop where it has none, so that tasks in several threads make
    one.
    """
    name = f"dentine-{factory}"
    if name not in worker.plugins:
        await worker.plugin_add(_EnginePlugin(factory), name=name, catch_errors=False)
    plugin: _EnginePlugin = worker.plugins[name]
    return plugin


def run_on_worker(factory: str, flag: Path, task: Task, *args: Any) -> Timed:
    """Run a task with its worker's child, until ``flag`` exists."""
    from distributed import get_worker
    from distributed.utils import sync

    worker = get_worker()
    plugin: _EnginePlugin = sync(worker.loop, _prepare_worker, worker, factory)
    began_s, earlier = time.monotonic(), [arg for arg in args if isinstance(arg, Timed)]
    given = [arg.value if isinstance(arg, Timed) else arg for arg in args]
    value = task(CancellableHost(plugin.host, flag), *given)
    seconds = time.monotonic() - began_s
    return Timed(value, seconds + sum(one.seconds for one in earlier), 1 + sum(one.tasks for one in earlier))


class Surroundings(NamedTuple):
    """The Dask task that this code runs in."""

    key: str
    needs: Mapping[str, float]
    """Resources of a worker that may run it."""


def _surroundings() -> Surroundings | None:
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        return None
    key = worker.get_current_task()
    return Surroundings(str(key), worker.state.tasks[key].resource_restrictions or {})


@contextmanager
def executor(flag: Path, factory: str = ENGINE, prefix: str = "fit", weight: float = 1.0) -> Iterator[Executor]:
    """The executor for where this code runs: inside a Dask task its cluster, holding no slot meanwhile; elsewhere this
    process.

    On a cluster tasks run where this one may, and their keys begin with its own, which tells whose they are.

    Args:
        flag: once it exists, what a worker renders is cut off.
        weight: share of the workers' time relative to other fits'.
    """
    surroundings = _surroundings()
    if surroundings is None:
        host = InProcessHost(factory)
        try:
            yield LocalExecutor(host)
        finally:
            host.close()
        return
    from distributed import worker_client

    name, share = f"{surroundings.key}-{prefix}", Share(weight)
    with (
        worker_client() as client,
        closing(DaskExecutor(client, factory, name, flag, surroundings.needs, share)) as run_on,
    ):
        yield run_on
