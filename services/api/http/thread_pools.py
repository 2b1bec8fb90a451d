"""Pools of threads for short work, such as queries of the database and rows that are appended to it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial, wraps
from typing import Any, ParamSpec, Self, TypeVar

import sqlalchemy as sql

MAX_DATABASE_THREADS = 8
"""Number of threads that read a database over a network, where most of the time is spent waiting."""
CLOSE_S = 5.0
"""Longest time in s that the end of the server waits for work under way."""
P = ParamSpec("P")
R = TypeVar("R")


class ThreadPool:
    """A pool of ``count`` threads, started when there is work. Work that may take long, or waits for other work,
    belongs elsewhere.
    """

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count, "short work")

    @classmethod
    def for_database(cls, engine: sql.Engine) -> Self:
        """Create a pool that reads the database: one thread where it is a file, as SQLite answers sooner than several
        threads can hand the interpreter lock to each other, which they must do after every query; else
        ``MAX_DATABASE_THREADS``.
        """
        return cls(1 if engine.dialect.name == "sqlite" else MAX_DATABASE_THREADS)

    async def run(self, work: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
        """Run the work in the pool and return its result."""
        return await asyncio.get_running_loop().run_in_executor(
            self._pool, partial(copy_context().run, work, *arguments, **options)
        )

    def wrap_handler(self, handler: Callable[P, R]) -> Callable[P, Coroutine[Any, Any, R]]:
        """Wrap a handler so that it runs in this pool, where FastAPI would run it in one of forty threads."""

        @wraps(handler)
        async def answer(*arguments: P.args, **options: P.kwargs) -> R:
            return await self.run(handler, *arguments, **options)

        return answer

    def close(self) -> None:
        """Wait for the work under way, at most ``CLOSE_S``."""
        closing = threading.Thread(target=self._pool.shutdown, name="end of short work", daemon=True)
        closing.start()
        closing.join(CLOSE_S)
