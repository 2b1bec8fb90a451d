"""Sends requests when they are due, whether earlier ones were answered or not, and measures from when each was due."""

from __future__ import annotations

import asyncio
import gc
import random
import selectors
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import aiohttp

from tests.load.processes import Served
from tests.load.request_mix import Ask

T = TypeVar("T")
KEPT_S = 2.0
"""How long an idle connection is kept: less than the servers' 5 s, or a request would meet its closing."""
PATIENCE_S = 600.0
"""How long an answer may take: whoever is slow is measured, not cut off."""


@dataclass(frozen=True)
class Answer:
    """How one request went."""

    kind: str
    latency_s: float
    status: int
    """0 where there was no answer."""
    is_right: bool
    body: bytes


def session(served: Served, connections: int = 256) -> aiohttp.ClientSession:
    """At most so many kept connections, 0 for any number; a request that finds all of them busy waits, which counts."""
    connector = aiohttp.TCPConnector(limit=connections, keepalive_timeout=KEPT_S)
    return aiohttp.ClientSession(
        served.address,
        connector=connector,
        headers=served.headers,
        timeout=aiohttp.ClientTimeout(total=None, sock_read=PATIENCE_S),
    )


def run(work: Coroutine[Any, Any, T]) -> T:
    """Run with ``select``, whose timeouts are finer than the millisecond of ``epoll``: a request is sent when it is
    due.
    """
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(selectors.SelectSelector())) as runner:
        return runner.run(work)


def poisson(rate_per_s: float, seconds: float, rng: random.Random) -> Iterator[float]:
    """Times at which independent users ask."""
    due_s = rng.expovariate(rate_per_s)
    while due_s < seconds:
        yield due_s
        due_s += rng.expovariate(rate_per_s)


async def offer(
    served: Served,
    plan: Sequence[tuple[float, Ask]],
    follow_up: Callable[[Answer], tuple[float, Ask] | None] = lambda _: None,
) -> list[Answer]:
    """Send the plan, times in seconds from now and in order, and what ``follow_up`` makes of each answer, so many
    seconds later.
    """
    answers: list[Answer] = []
    loop = asyncio.get_running_loop()
    async with session(served) as http, asyncio.TaskGroup() as sending:

        async def send(ask: Ask, due_s: float) -> None:
            answer = await send_one(http, ask, due_s)
            answers.append(answer)
            if (more := follow_up(answer)) is not None:
                await asyncio.sleep(more[0])
                answers.append(await send_one(http, more[1], loop.time()))

        with _without_collection():
            began_s = loop.time() + 0.05
            for due_s, ask in plan:
                await asyncio.sleep(max(began_s + due_s - loop.time(), 0.0))
                sending.create_task(send(ask, began_s + due_s))
    return answers


async def send_one(http: aiohttp.ClientSession, ask: Ask, due_s: float) -> Answer:
    """Send one request that was due at this time of the loop's clock."""
    loop = asyncio.get_running_loop()
    try:
        async with http.request(ask.method, ask.path, headers=ask.headers, json=ask.body) as response:
            body = await response.read()
            return Answer(ask.kind, loop.time() - due_s, response.status, response.status in ask.statuses, body)
    except (aiohttp.ClientError, TimeoutError) as problem:
        return Answer(ask.kind, loop.time() - due_s, 0, is_right=False, body=repr(problem).encode())


@contextmanager
def _without_collection() -> Iterator[None]:
    """Keep the client's own pauses out of what is measured."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
