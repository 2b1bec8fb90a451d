"""The connections of one server: how many there may be, and how long each may keep a request to itself before its head
is whole.

Whoever opens connections and sends no whole request, by mistake or to keep others out, loses them: after ``header_s``,
or at once where a newcomer finds all places taken; those that have sent a request before are closed last. So there is
always one for ALL OFF.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import resource
from contextlib import suppress
from functools import partial
from typing import Any, cast

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from services.core.settings import ConnectionLimits

MAX_DESCRIPTORS = 65_536
"""Asked of the system, which by default gives 1,024: files of jobs and pipes to workers count too."""
MAX_SHARE = 0.5
"""Of the descriptors, for connections."""
MAX_BACKLOG = 256
"""Connections that are accepted in one go: more would keep the event loop busy for more than some ten milliseconds."""
TOLD_EVERY_S = 600.0
"""How often the log is told of what goes on happening."""
SHED = 16
"""Connections without a request that are closed when descriptors run out."""
_OUT_OF_DESCRIPTORS = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"


class Crowd:
    """The open connections, and of those the ones without a request, longest waiting first: those that never sent one,
    and those that did.
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        self.most, self.header_s = min(limits.most, round(MAX_SHARE * raise_descriptors())), limits.header_s
        self.open: set[BoundedProtocol] = set()
        self.fresh: dict[BoundedProtocol, None] = {}
        self.served: dict[BoundedProtocol, None] = {}
        self._told_at: dict[str, float] = {}

    def admit(self, newcomer: BoundedProtocol) -> bool:
        """Let a connection in, in place of the one that has waited longest where all places are taken; False where all
        are at work.
        """
        if len(self.open) >= self.most and not self.shed(1):
            self.tell(
                "All %d connections are at work; further ones are refused. See DENTINE__SERVER__CONNECTIONS__MOST.",
                self.most,
            )
            return False
        self.open.add(newcomer)
        return True

    def shed(self, count: int) -> int:
        """Close so many connections without a request; returns how many there were."""
        chosen = [*self.fresh, *self.served][:count]
        for one in chosen:
            self.leave(one)
            one.transport.abort()
        if chosen:
            self.tell("Connections without a request are closed to make room for others.")
        return len(chosen)

    def leave(self, one: BoundedProtocol) -> None:
        """Forget a connection."""
        self.open.discard(one)
        self.end_wait(one)

    def wait(self, one: BoundedProtocol, *, is_fresh: bool) -> None:
        """Note that a connection has no request."""
        (self.fresh if is_fresh else self.served)[one] = None

    def end_wait(self, one: BoundedProtocol) -> None:
        """Note that it has one, or is closed."""
        self.fresh.pop(one, None)
        self.served.pop(one, None)

    def tell(self, message: str, *values: object) -> None:
        """Log something once, and again after a while if it goes on."""
        now = asyncio.get_running_loop().time()
        if now >= self._told_at.get(message, now):
            self._told_at[message] = now + TOLD_EVERY_S
            logging.getLogger(__name__).warning(message, *values)

    def handle_exception(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Of the event loop: an accept without descriptors, of which it would tell some hundred times a second, makes
        room and is told once.
        """
        problem = context.get("exception")
        if (
            isinstance(problem, OSError)
            and problem.errno in _OUT_OF_DESCRIPTORS
            and "accept" in context.get("message", "")
        ):
            self.tell(
                "No descriptor is left for further connections (%s); raise the limit of open files.", problem.strerror
            )
            self.shed(SHED)
        else:
            loop.default_exception_handler(context)


class BoundedProtocol(H11Protocol):
    """HTTP/1.1 on one connection of a crowd."""

    def __init__(self, crowd: Crowd, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._crowd, self._limit = crowd, cast("asyncio.TimerHandle | None", None)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has connected."""
        super().connection_made(transport)
        if self._crowd.admit(self):
            self._await_request()
        else:
            transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is closed."""
        self._end_wait()
        self._crowd.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes have come, which alone prolong nothing."""
        super().data_received(data)
        if self._is_at_work:
            self._end_wait()

    def on_response_complete(self) -> None:
        """A request was answered; the next one may come."""
        super().on_response_complete()
        if not self._is_at_work and not self.transport.is_closing():
            self._await_request()

    @property
    def _is_at_work(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _await_request(self) -> None:
        self._end_wait()
        self._crowd.wait(self, is_fresh=self.cycle is None)
        self._limit = self.loop.call_later(self._crowd.header_s, self._close)

    def _end_wait(self) -> None:
        self._crowd.end_wait(self)
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None

    def _close(self) -> None:
        if self.conn.trailing_data[0]:
            self.transport.write(_TOO_SLOW)
        self.transport.close()


class BoundedServer(uvicorn.Server):
    """A server over a crowd of connections."""

    def __init__(self, config: uvicorn.Config, limits: ConnectionLimits) -> None:
        self._crowd = Crowd(limits)
        config.http = cast("Any", partial(BoundedProtocol, self._crowd))
        config.backlog = MAX_BACKLOG
        super().__init__(config)

    async def startup(self, sockets: Any = None) -> None:
        """Begin to listen."""
        asyncio.get_running_loop().set_exception_handler(self._crowd.handle_exception)
        await super().startup(sockets)


def raise_descriptors() -> int:
    """Let this process have as many open files as the system allows; returns how many."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MAX_DESCRIPTORS)
    if soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]
