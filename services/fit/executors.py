"""Where tasks run: here, one after the other, or on the workers of a Dask cluster. A task is ``task(host, *args)``; arguments may be earlier results."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from distributed import WorkerPlugin

from services.fit.engine_host import ENGINE, CancellableHost, ChildHost, EngineHost, InProcessHost

Task = Callable[..., Any]


class Executor(Protocol):
    """Runs tasks."""

    def submit(self, key: str, task: Task, *args: Any) -> Any:
        """Start ``task(host, *args)``; returns something that later submits and ``gather`` take."""

    def gather(self, pending: Sequence[Any]) -> list[Any]:
        """Results in the order given. Raises what a task raised."""


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


class DaskExecutor:
    """Runs tasks on any worker that has what they need; a worker's tasks share its one child process.

    Args:
        needs: Dask resources of a worker that may run the tasks.
    """

    def __init__(self, client: Any, factory: str, prefix: str, flag: Path, needs: Mapping[str, float] | None = None) -> None:
        self._client, self._prefix, self._plugin, self._submitted = client, prefix, plugin_name(factory), itertools.count()
        self._flag, self._needs = flag, dict(needs or {})
        client.register_plugin(_EnginePlugin(factory), name=self._plugin)

    def submit(self, key: str, task: Task, *args: Any) -> Any:
        """See Executor. Dask answers for a key that it still knows with the old result, so each task has its own.

        A task whose worker dies runs again elsewhere; what a task raises is final, as the same seeds would raise it again.
        """
        own = f"{self._prefix}-{next(self._submitted)}-{key}"
        return self._client.submit(run_on_worker, self._plugin, self._flag, task, *args, key=own, pure=False, resources=self._needs)

    def gather(self, pending: Sequence[Any]) -> list[Any]:
        """See Executor."""
        return list(self._client.gather(list(pending)))


class _EnginePlugin(WorkerPlugin):
    """A worker's child process, made at its first task and ended with the worker."""

    name = "dentine-engine"
    idempotent = True

    def __init__(self, factory: str) -> None:
        self._factory = factory
        self.host: ChildHost | None = None

    def setup(self, worker: Any) -> None:
        """Called by Dask on every worker, late-comers included."""
        self.host = ChildHost(self._factory, worker.state.nthreads, worker.memory_manager.memory_limit)

    def teardown(self, worker: Any) -> None:  # noqa: ARG002 - Dask's signature
        """Called by Dask when the worker closes."""
        if self.host is not None:
            self.host.close()


def plugin_name(factory: str) -> str:
    """Name under which a worker keeps the child for an engine."""
    return f"dentine-{factory}"


def run_on_worker(plugin: str, flag: Path, task: Task, *args: Any) -> Any:
    """Run a task with its worker's child, until ``flag`` exists."""
    from distributed import get_worker

    return task(CancellableHost(get_worker().plugins[plugin].host, flag), *args)


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
def executor(flag: Path, factory: str = ENGINE, prefix: str = "fit") -> Iterator[Executor]:
    """The executor for where this code runs: inside a Dask task its cluster, holding no slot meanwhile; elsewhere this process.

    On a cluster tasks run where this one may, and their keys begin with its own, so that whoever looks at the workers knows whose they are.

    Args:
        flag: once it exists, what a worker renders is cut off.
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

    with worker_client() as client:
        yield DaskExecutor(client, factory, f"{surroundings.key}-{prefix}", flag, surroundings.needs)
