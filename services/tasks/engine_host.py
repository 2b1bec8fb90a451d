"""Hosts of the rendering engine: this process, or a child process of a Dask worker.

A kernel can hold the interpreter lock for seconds, and the scheduler takes a worker that does not answer for dead. So
each worker keeps one child, a fresh interpreter that owns Mitsuba, the built scenes and the kernels, and the worker's
task only waits on a pipe. A child that dies (out of memory, kill) is started again and gets the request once more. A
child whose worker dies sees its pipe close and ends itself, even while a kernel runs. While it waits, the task checks
the child's memory and the job's cancel flag, and ends the child if necessary; the worker lives on.
"""

from __future__ import annotations

import importlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, Protocol

from services.core.errors import WorkerLostError
from services.core.files.content_files import StoredFile
from services.core.stage import raise_if
from services.tasks.engine_process import EngineProcess

ENGINE = "services.transport.engine:Engine"
"""Default engine, as ``module:class``; imported only in the process that renders."""
SCENE_READER = "services.transport.scene.recipe_files:read_recipe"
"""Function that reads a scene from its file, as ``module:function``; imported in the same process."""
MAX_SCENES = 4
"""Largest number of built scenes that a process keeps."""
WATCH_S = 0.25
"""Interval in seconds at which a waiting task checks the child's memory and the cancel flag."""


class EngineHost(Protocol):
    """Host that executes calls on an engine whose scene is given by its recipe file."""

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """``getattr(engine, method)(*args, **options)`` on the engine built from ``recipe``."""

    def close(self) -> None:
        """Release what the host holds."""


def _named(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


class InProcessHost:
    """Host with the engine in this process; keeps the scenes that were used last."""

    def __init__(self, factory: str = ENGINE, threads: int | None = None) -> None:
        self._factory, self._threads = factory, threads
        self._engines: OrderedDict[str, Any] = OrderedDict()

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """See EngineHost."""
        engine = self._engines.get(recipe.digest)
        if engine is None:
            engine = _named(self._factory)(_named(SCENE_READER)(recipe), self._threads)
            self._engines[recipe.digest] = engine
            while len(self._engines) > MAX_SCENES:
                self._engines.popitem(last=False)
        self._engines.move_to_end(recipe.digest)
        return getattr(engine, method)(*args, **options)

    def close(self) -> None:
        """Release the scenes."""
        self._engines.clear()


class ChildHost:
    """Host with the engine in one child process, started at the first call and again after it died.

    Args:
        factory: the engine, as ``module:class``.
        threads: number of threads that the engine may use; None for its default.
        memory_bytes: largest memory of the child; None for no limit but the system's.
    """

    def __init__(self, factory: str = ENGINE, threads: int | None = None, memory_bytes: int | None = None) -> None:
        self._command = [sys.executable, "-m", "services.tasks.engine_host"], [factory, str(threads or 0)]
        self._memory_bytes = memory_bytes
        self._lock, self._is_closed = threading.Lock(), threading.Event()
        self._process: EngineProcess | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        return self._process.pid if self._process is not None else None

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """See EngineHost. One call at a time.

        Raises:
            MemoryKillError: the child grew beyond its limit, or the system killed it for lack of memory.
            CrashError: the child died twice in this call.
            WorkerLostError: the host was closed meanwhile.
        """
        return self.call_until(lambda: False, method, recipe, *args, **options)

    def call_until(
        self, is_cancelled: Callable[[], bool], method: str, recipe: StoredFile, *args: Any, **options: Any
    ) -> Any:
        """Like ``call``, but once ``is_cancelled()`` the child is ended even while a kernel runs.

        A call that still waits for the kernel of another job ends too, and leaves that kernel alone.
        """
        request = pickle.dumps((method, recipe, args, options))
        with self._turn(is_cancelled):
            for is_last in (False, True):
                raise_if(is_cancelled)
                self._require_open()
                self._process = process = self._process or self._start()
                try:
                    process.pipe.send_bytes(request)
                    while not process.pipe.poll(WATCH_S):
                        raise_if(is_cancelled)
                        self._require_open()
                        process.check_memory()
                    succeeded, value = pickle.loads(process.pipe.recv_bytes())  # noqa: S301 - from our own child over our own pipe
                except (EOFError, ConnectionError):
                    self._end()
                    self._require_open()
                    if is_last or process.was_out_of_memory:
                        raise process.exit_error() from None
                    continue
                except BaseException:
                    self._end()  # the answer to this call must not become that to the next
                    raise
                if succeeded:
                    return value
                raise value
        raise AssertionError

    def close(self) -> None:
        """End the child, even while a kernel runs; a caller that waits for its result gets WorkerLostError.

        No call may follow.
        """
        self._is_closed.set()
        with self._lock:
            self._end()

    @contextmanager
    def _turn(self, is_cancelled: Callable[[], bool]) -> Iterator[None]:
        """Have the child for one call, once no other call has it."""
        while not self._lock.acquire(timeout=WATCH_S):
            raise_if(is_cancelled)
        try:
            yield
        finally:
            self._lock.release()

    def _require_open(self) -> None:
        if self._is_closed.is_set():
            raise WorkerLostError("The worker was closed while it rendered; its task runs again on another one.")

    def _start(self) -> EngineProcess:
        ours, theirs = Pipe()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        module, arguments = self._command
        command = [*module, str(theirs.fileno()), *arguments]
        process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment, stdin=subprocess.DEVNULL)  # noqa: S603
        theirs.close()
        return EngineProcess(process, ours, self._memory_bytes)

    def _end(self) -> None:
        if self._process is not None:
            self._process.end()
            self._process = None


@dataclass(frozen=True)
class CancellableHost:
    """Host of one job's tasks: the worker's child process, with the job's cancel flag."""

    child: ChildHost
    flag: Path
    """File that exists once the job was cancelled."""

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """See ChildHost."""
        return self.child.call_until(self.flag.exists, method, recipe, *args, **options)

    def close(self) -> None:
        """Do nothing, because the child belongs to its worker."""


def serve(descriptor: int, factory: str, threads: int | None) -> None:
    """Execute calls until the pipe closes. Runs in the child process."""
    pipe: Connection[Any, Any] = Connection(descriptor)
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        # End the process as soon as its worker is gone, whatever the main thread computes.
        while True:
            try:
                requests.put(pipe.recv_bytes())
            except (EOFError, OSError):
                os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    host = InProcessHost(factory, threads)
    while True:
        method, recipe, args, options = pickle.loads(requests.get())  # noqa: S301 - from our own parent over our own pipe
        try:
            answer = pickle.dumps((True, host.call(method, recipe, *args, **options)))
        except Exception as problem:
            answer = pickle.dumps((False, _portable(problem)))
        pipe.send_bytes(answer)


def _portable(problem: Exception) -> Exception:
    """An exception that survives a pipe: the original where it can be pickled, else a RuntimeError with its text.
    Exceptions that need more than their arguments cannot be restored from a pickle.
    """
    try:
        if type(pickle.loads(pickle.dumps(problem))) is type(problem):  # noqa: S301 - made on the line itself
            return problem
    except Exception as refusal:
        problem.add_note(f"It cannot be sent between processes: {refusal}")
    return RuntimeError(f"{type(problem).__name__}: {problem}")


if __name__ == "__main__":
    serve(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]) or None)
