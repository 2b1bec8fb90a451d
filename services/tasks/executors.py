"""Executors of tasks: in this process, one after the other, or on the workers of a Dask cluster.

A task is ``task(host, *args)``; its arguments may be results of earlier tasks.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from distributed import WorkerPlugin

from services.core.stage import raise_if
from services.tasks.engine_host import (
    ENGINE,
    WATCH_S,
    CancellableHost,
    ChildHost,
    EngineHost,
    InProcessHost,
)
from services.tasks.fair_shares import PublishedLevels, Share

Task = Callable[..., Any]
Call = tuple[str, Task, tuple[Any, ...]]
"""Arguments of ``submit``: a key, a task and its arguments."""
TASKS_AHEAD = 2
"""Number of a job's tasks that are with the workers at once, per worker thread: one runs, and the next follows without
delay."""


class Executor(Protocol):
    """Executor of tasks on engine hosts."""

    def submit(self, key: str, task: Task, *args: Any) -> Any:
        """Start ``task(host, *args)``; returns a handle that later submits and ``gather`` take."""

    def gather(self, pending: Sequence[Any]) -> list[Any]:
        """Results in the order of ``pending``. Raises what a task raised."""

    def as_completed(self, calls: Sequence[Call]) -> Iterator[Any]:
        """Run tasks that depend on no other task, and yield the result of each as soon as it has ended.

        Raises what a task raised; tasks that have not begun by then, or when the caller asks for no more, never run.
        """

    def threads(self, expected: int = 1) -> int:
        """Number of tasks that can run at once; on a cluster at least ``expected``, because some of the requested
        workers may still be starting.
        """


class LocalExecutor:
    """Executor that runs each task when it is submitted, in this process or in a child of it."""

    def __init__(self, host: EngineHost) -> None:
        self._host = host

    def submit(self, key: str, task: Task, *args: Any) -> Any:  # noqa: ARG002 - keys name tasks on a cluster
        """See Executor."""
        return task(self._host, *args)

    def gather(self, pending: Sequence[Any]) -> list[Any]:
        """See Executor."""
        return list(pending)

    def as_completed(self, calls: Sequence[Call]) -> Iterator[Any]:
        """See Executor; runs one after the other."""
        for key, task, args in calls:
            yield self.submit(key, task, *args)

    def threads(self, expected: int = 1) -> int:  # noqa: ARG002 - this process is alone
        """See Executor."""
        return 1


class DaskExecutor:
    """Executor on any Dask worker that has the needed resources; all tasks of a worker share its one child process.

    Only a few tasks are with the workers at a time, so that tasks of another job run in between; see ``fair_shares``.

    Args:
        client: connection to the scheduler.
        factory: the engine, as ``module:class``.
        prefix: begins the keys of this job's tasks.
        flag: file whose existence cancels the tasks.
        resources: Dask resources that a worker must have to run the tasks.
        share: worker time that this job has used.
    """

    def __init__(
        self,
        client: Any,
        factory: str,
        prefix: str,
        flag: Path,
        resources: Mapping[str, float] | None = None,
        share: Share | None = None,
    ) -> None:
        self._client, self._factory, self._prefix, self._submitted = client, factory, prefix, itertools.count()
        self._flag, self._resources, self._share = flag, dict(resources or {}), share or Share()
        self._levels = PublishedLevels(client, prefix, self._share)
        self._levels.join()
        self._waiting: deque[_Planned] = deque()
        self._running: dict[Any, _Planned] = {}

    def submit(self, key: str, task: Task, *args: Any) -> _Planned:
        """See Executor. Every task gets a key of its own, because Dask returns the old result for a key that it still
        knows.

        A task whose worker dies runs again elsewhere. An exception of a task is final, because the same seeds would
        raise it again.
        """
        planned = _Planned(f"{self._prefix}-{next(self._submitted)}-{key}", task, args)
        self._waiting.append(planned)
        return planned

    def gather(self, pending: Sequence[_Planned]) -> list[Any]:
        """See Executor."""
        for _ in self._ending(pending):
            pass
        return [planned.timed.value for planned in pending]

    def as_completed(self, calls: Sequence[Call]) -> Iterator[Any]:
        """See Executor."""
        for planned in self._ending([self.submit(key, task, *args) for key, task, args in calls]):
            yield planned.timed.value

    def _ending(self, pending: Sequence[_Planned]) -> Iterator[_Planned]:
        """Yield tasks as they end, and send waiting tasks meanwhile."""
        most, missing = TASKS_AHEAD * self.threads(), set(pending)
        try:
            while missing:
                while self._waiting and len(self._running) < most:
                    self._send(self._waiting.popleft())
                assert self._running, "a task that was given up is awaited"
                self._levels.publish()
                for future in self._next_ended():
                    planned = self._running.pop(future)
                    if future.status != "finished":
                        future.result()  # raises
                    if planned in missing:  # else its result goes to another task, which counts its time
                        missing.remove(planned)
                        planned.timed = future.result()
                        self._share.end(planned.timed.seconds, planned.timed.tasks)
                        yield planned
        finally:
            if missing:
                self._give_up()

    def _next_ended(self) -> Iterable[Any]:
        """Wait until at least one task has ended, and return those that have.

        Raises:
            JobCancelledError: the job was cancelled; its tasks may wait behind long ones of other jobs.
        """
        from distributed import wait

        while True:
            raise_if(self._flag.exists)
            with suppress(TimeoutError):
                ended: Iterable[Any] = wait(list(self._running), WATCH_S, return_when="FIRST_COMPLETED").done
                return ended

    def _give_up(self) -> None:
        """Let no task begin that has not begun yet."""
        self._waiting.clear()
        if self._running:
            self._client.cancel(list(self._running))
            self._running.clear()

    def close(self) -> None:
        """Release this job's place among those that share the workers."""
        self._levels.leave()

    def _send(self, planned: _Planned) -> None:
        # Pass futures as arguments, so that results of earlier tasks go from worker to worker.
        args = [arg.future if isinstance(arg, _Planned) else arg for arg in planned.args]
        options = {"resources": self._resources, "priority": self._share.begin(), "key": planned.key, "pure": False}
        planned.future = self._client.submit(run_on_worker, self._factory, self._flag, planned.task, *args, **options)
        planned.args = ()
        self._running[planned.future] = planned

    def threads(self, expected: int = 1) -> int:
        """See Executor."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        present = sum(
            int(worker["nthreads"])
            for worker in workers
            if all(worker["resources"].get(name, 0) >= amount for name, amount in self._resources.items())
        )
        return max(present, expected)


@dataclass(eq=False)
class _Planned:
    """A task of a job, from its submission to its result."""

    key: str
    task: Task
    args: tuple[Any, ...]
    future: Any = None
    timed: Any = None


class Timed(NamedTuple):
    """Result of a task, and the worker time spent on it."""

    value: Any
    seconds: float
    """Worker time in seconds of this task and of the earlier tasks whose results it took; these are counted
    here alone."""
    tasks: int


class _EnginePlugin(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Owner of a worker's child process, which starts at the worker's first task and ends with the worker."""

    def __init__(self, factory: str) -> None:
        self._factory = factory

    def setup(self, worker: Any) -> None:
        """Called by Dask when it is added to a worker."""
        self.host = ChildHost(self._factory, worker.state.nthreads, worker.memory_manager.memory_limit)

    def teardown(self, worker: Any) -> None:  # noqa: ARG002 - Dask's signature
        """Called by Dask when the worker closes."""
        self.host.close()


async def _prepare_worker(worker: Any, factory: str) -> _EnginePlugin:
    """The engine's plugin of a worker, created on the worker's event loop where there is none, so that tasks in several
    threads create only one.
    """
    name = f"dentine-{factory}"
    if name not in worker.plugins:
        await worker.plugin_add(_EnginePlugin(factory), name=name, catch_errors=False)
    plugin: _EnginePlugin = worker.plugins[name]
    return plugin


def run_on_worker(factory: str, flag: Path, task: Task, *args: Any) -> Timed:
    """Run a task with its worker's child process, until ``flag`` exists."""
    from distributed import get_worker
    from distributed.utils import sync

    raise_if(flag.exists)
    worker = get_worker()
    plugin: _EnginePlugin = sync(worker.loop, _prepare_worker, worker, factory)
    began_s, earlier = time.monotonic(), [arg for arg in args if isinstance(arg, Timed)]
    values = [arg.value if isinstance(arg, Timed) else arg for arg in args]
    value = task(CancellableHost(plugin.host, flag), *values)
    seconds = time.monotonic() - began_s
    return Timed(value, seconds + sum(one.seconds for one in earlier), 1 + sum(one.tasks for one in earlier))


def threads_here() -> int:
    """Number of tasks that may run in this process at once and share its memory: its Dask worker's threads, or 1."""
    from distributed import get_worker

    try:
        return max(1, int(get_worker().state.nthreads))
    except ValueError:
        return 1


class EnclosingTask(NamedTuple):
    """Key and resources of the Dask task in which this code runs."""

    key: str
    resources: Mapping[str, float]
    """Dask resources that a worker must have to run the task."""


def _enclosing_task() -> EnclosingTask | None:
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        return None
    key = worker.get_current_task()
    return EnclosingTask(str(key), worker.state.tasks[key].resource_restrictions or {})


@contextmanager
def executor(flag: Path, factory: str = ENGINE, prefix: str = "fit", weight: float = 1.0) -> Iterator[Executor]:
    """Executor for the place where this code runs: inside a Dask task its cluster, without holding a slot meanwhile;
    elsewhere this process.

    On a cluster, tasks need the resources of the enclosing task, and their keys begin with its key, which shows their
    owner.

    Args:
        flag: file whose existence cancels the rendering on the workers.
        factory: the engine, as ``module:class``.
        prefix: follows the enclosing task's key in the keys of the tasks.
        weight: share of the workers' time relative to other jobs'.
    """
    enclosing = _enclosing_task()
    if enclosing is None:
        host = InProcessHost(factory)
        try:
            yield LocalExecutor(host)
        finally:
            host.close()
        return
    from distributed import worker_client

    name, share = f"{enclosing.key}-{prefix}", Share(weight)
    with (
        worker_client() as client,
        closing(DaskExecutor(client, factory, name, flag, enclosing.resources, share)) as run_on,
    ):
        yield run_on
