"""Threads that do short work in order: what only asks the database, and what only appends to it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial, wraps
from typing import Any, ParamSpec, Self, TypeVar

import sqlalchemy as sql

MAX_READERS = 8
"""Of a database over a network, where most of the time is waiting."""
CLOSE_S = 5.0
"""How long the server's end waits for work that is under way."""
P = ParamSpec("P")
R = TypeVar("R")


class ThreadPool:
    """So many threads, begun when there is work. What may take long, or waits for others, belongs elsewhere."""

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count, "short work")

    @classmethod
    def reading(cls, engine: sql.Engine) -> Self:
        """One where the database is a file: it answers sooner than threads wrest the interpreter from each other, which
        each of them must after every query.
        """
        return cls(1 if engine.dialect.name == "sqlite" else MAX_READERS)

    async def ask(self, work: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
        """What the work returns."""
        return await asyncio.get_running_loop().run_in_executor(
            self._pool, partial(copy_context().run, work, *arguments, **options)
        )

    def answering(self, handler: Callable[P, R]) -> Callable[P, Coroutine[Any, Any, R]]:
        """Let a handler be called here, where FastAPI would call it in one of forty threads."""

        @wraps(handler)
        async def answer(*arguments: P.args, **options: P.kwargs) -> R:
            return await self.ask(handler, *arguments, **options)

        return answer

    def close(self) -> None:
        """Wait for what is under way, but not for what hangs."""
        closing = threading.Thread(target=self._pool.shutdown, name="end of short work", daemon=True)
        closing.start()
        closing.join(CLOSE_S)
