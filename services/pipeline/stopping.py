"""End the tasks of one stage on the workers, and nothing else that runs there."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from services.core.errors import JobCancelledError

if TYPE_CHECKING:
    from distributed import Client


class InterruptedTaskError(JobCancelledError):
    """Raised inside a task of a cancelled job that did not end by itself."""

    code = "task-interrupted"

    def __init__(
        self,
        message: str = "The job was cancelled on request; its tasks were stopped, and what it had published is kept.",
    ) -> None:
        super().__init__(message)


def stop_tasks(client: Client, prefix: str, timeout_s: float) -> bool:
    """Stop the tasks whose keys begin with ``prefix``; returns False while some of them still run.

    A worker that holds no other task is restarted. Where a worker also holds a task or a result of another job, only
    the threads of the own tasks are interrupted, and the worker stays; call again to see whether they have ended.

    Args:
        timeout_s: longest time in s that the workers may take to answer.
    """
    given, kept = client.processing(), client.has_what()
    own = [worker for worker, keys in given.items() if any(str(key).startswith(prefix) for key in keys)]
    shared = [
        worker
        for worker in own
        if any(not str(key).startswith(prefix) for key in (*given[worker], *kept.get(worker, ())))
    ]
    with suppress(TimeoutError):
        if shared and client.sync(_interrupt, client, prefix, shared, callback_timeout=timeout_s):
            return False
        if alone := [worker for worker in own if worker not in shared]:
            client.restart_workers(alone, timeout=timeout_s)
        return True
    return False


async def _interrupt(client: Client, prefix: str, workers: list[str]) -> int:
    """Interrupt the running tasks of ``prefix`` on some workers; returns their number."""
    counts: dict[str, Any] = await client.run(interrupt_threads, prefix, workers=workers, on_error="ignore")
    return sum(counts.values())


def interrupt_threads(prefix: str, dask_worker: Any) -> int:
    """Raise ``InterruptedTaskError`` in each thread of a worker that runs a task of ``prefix``; returns their number.

    Python raises it before the thread's next instruction, so a thread that waits inside a library ends later.
    """
    with dask_worker.active_threads_lock:
        threads = [one for one, key in dask_worker.active_threads.items() if str(key).startswith(prefix)]
        for thread in threads:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(InterruptedTaskError))
    return len(threads)
