"""Who owns the renderer: this process, or a child process of a Dask worker.

A kernel can hold the interpreter lock for seconds, and a worker that cannot answer its scheduler is taken for dead. So each worker keeps one child, a
fresh interpreter that owns Mitsuba, the built scenes and the kernels. The worker's task only waits on a pipe. A child that dies (out of memory, kill) is
started again and asked once more; a child whose worker dies sees its pipe close and ends itself, also in mid-kernel.
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
from multiprocessing.connection import Connection, Pipe
from typing import Any, Protocol

from services.core.errors import PlatformError
from services.fit.blocks import StoredFile, read_recipe

ENGINE = "services.fit.transport.engine:Engine"
"""Default engine, as ``module:class``; imported only where it runs."""
SCENES_KEPT = 4


class EngineHost(Protocol):
    """Answers calls to an engine whose scene is named by its recipe file."""

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """``getattr(engine, method)(*args, **options)`` on the engine built from ``recipe``."""

    def close(self) -> None:
        """Release what the host holds."""


class InProcessHost:
    """The engine in this very process; keeps the last few scenes built."""

    def __init__(self, factory: str = ENGINE, threads: int | None = None) -> None:
        self._factory, self._threads = factory, threads
        self._engines: OrderedDict[str, Any] = OrderedDict()

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """See EngineHost."""
        engine = self._engines.get(recipe.digest)
        if engine is None:
            module, name = self._factory.split(":")
            engine = getattr(importlib.import_module(module), name)(read_recipe(recipe), self._threads)
            self._engines[recipe.digest] = engine
            while len(self._engines) > SCENES_KEPT:
                self._engines.popitem(last=False)
        self._engines.move_to_end(recipe.digest)
        return getattr(engine, method)(*args, **options)

    def close(self) -> None:
        """Forget the scenes."""
        self._engines.clear()


class ChildHost:
    """The engine in one child process, started at the first call and again after it died."""

    def __init__(self, factory: str = ENGINE, threads: int | None = None) -> None:
        self._factory, self._threads = factory, threads
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection[Any, Any] | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        return self._process.pid if self._process is not None else None

    def call(self, method: str, recipe: StoredFile, *args: Any, **options: Any) -> Any:
        """See EngineHost. One call at a time.

        Raises:
            PlatformError: the child died twice in this call.
        """
        request = pickle.dumps((method, recipe, args, options))
        with self._lock:
            for _ in range(2):
                try:
                    pipe = self._connect()
                    pipe.send_bytes(request)
                    succeeded, value = pickle.loads(pipe.recv_bytes())  # noqa: S301 - from our own child over our own pipe
                except (EOFError, ConnectionError):
                    self._end()
                    continue
                if succeeded:
                    return value
                raise value
        raise PlatformError("The rendering process ended twice in one task, most likely for lack of memory; lower samples_per_pixel or raise pixel_step.")

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._end()

    def _connect(self) -> Connection[Any, Any]:
        if self._pipe is None:
            self._pipe, theirs = Pipe()
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
            command = [sys.executable, "-m", "services.fit.engine_host", str(theirs.fileno()), self._factory, str(self._threads or 0)]
            self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment, stdin=subprocess.DEVNULL)  # noqa: S603
            theirs.close()
        return self._pipe

    def _end(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def serve(descriptor: int, factory: str, threads: int | None) -> None:
    """Answer calls until the pipe closes. Runs in the child."""
    pipe: Connection[Any, Any] = Connection(descriptor)
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        # Ends the process the moment its worker is gone, whatever the main thread computes.
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
            answer = pickle.dumps((False, problem))
        pipe.send_bytes(answer)


if __name__ == "__main__":
    serve(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]) or None)
