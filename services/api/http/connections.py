"""Limits the connections of one server: their number, and how long each may take to send the head of a request.

A client that opens connections and sends no complete request, by mistake or to keep others out, loses them: after
``header_s``, or at once when a new connection finds all places taken. Connections that have sent a request before are
closed last.

Requests that darken a dome have places of their own. A connection that finds all others at work gets one of these, and
any other request on it is refused. So there is always a place for ALL OFF.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import resource
from contextlib import suppress
from functools import partial
from typing import Any, cast

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from services.api.http.problems import response_of
from services.core.errors import PlatformError
from services.core.settings import ConnectionLimits

MAX_DESCRIPTORS = 65_536
"""Number of open files that is requested from the operating system, which by default allows 1,024. Files of jobs and
pipes to workers count too."""
MAX_SHARE = 0.5
"""Largest share of the file descriptors that connections may take."""
MAX_BACKLOG = 256
"""Largest number of connections that are accepted in one go. More would keep the event loop busy for more than some ten
milliseconds."""
WARNING_INTERVAL_S = 600.0
"""Time in s after which a warning is logged again if its cause persists."""
DARKENING_PLACES = 32
"""Number of places that only requests that darken a dome may use, beside those of all connections."""
_DARKENING = re.compile(r"(POST /v1/dome/off|DELETE /v1/dome/light|POST /v1/jobs/[^/]+/cancel)")
SHED_COUNT = 16
"""Number of connections without a request that are closed when file descriptors run out."""
_OUT_OF_DESCRIPTORS = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"


class ConnectionLimiter:
    """The open connections. Those without a request are kept in the order in which they began to wait: ``fresh`` ones
    have never sent a request, ``served`` ones have.
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        most = min(limits.most, round(MAX_SHARE * raise_descriptors()))
        self.max_darkening = min(DARKENING_PLACES, most // 4)
        self.max_open, self.header_s = min(limits.most, most - self.max_darkening), limits.header_s
        self.darkening: dict[BoundedProtocol, None] = {}
        self.open: set[BoundedProtocol] = set()
        self.fresh: dict[BoundedProtocol, None] = {}
        self.served: dict[BoundedProtocol, None] = {}
        self._next_warning_s: dict[str, float] = {}

    def admit(self, connection: BoundedProtocol) -> bool:
        """Admit a new connection. Where all places are taken, the connection that has waited longest without a request
        is closed for it; where all connections are at work, it gets one of the places that are for darkening a dome.
        Returns False where there is none of these either.
        """
        if len(self.open) >= self.max_open and not self.shed(1):
            self.warn(
                "All %d connections are at work; further ones are refused. See DENTINE__SERVER__CONNECTIONS__MOST.",
                self.max_open,
            )
            return self._admit_to_darken(connection)
        self.open.add(connection)
        return True

    def _admit_to_darken(self, connection: BoundedProtocol) -> bool:
        if len(self.darkening) >= self.max_darkening:
            waiting = next((one for one in self.darkening if not one.is_at_work), None)
            if waiting is None:
                return False
            self.leave(waiting)
            waiting.transport.abort()
        self.darkening[connection] = None
        connection.allow_only_darkening()
        return True

    def shed(self, count: int) -> int:
        """Close up to ``count`` connections without a request; returns how many were closed."""
        chosen = [*self.fresh, *self.served][:count]
        for connection in chosen:
            self.leave(connection)
            connection.transport.abort()
        if chosen:
            self.warn("Connections without a request are closed to make room for others.")
        return len(chosen)

    def leave(self, connection: BoundedProtocol) -> None:
        """Remove a connection from the open and the waiting ones."""
        self.open.discard(connection)
        self.darkening.pop(connection, None)
        self.end_wait(connection)

    def wait(self, connection: BoundedProtocol, *, is_fresh: bool) -> None:
        """Note that a connection waits for a request, and whether it has never sent one (``is_fresh``)."""
        if connection not in self.darkening:
            (self.fresh if is_fresh else self.served)[connection] = None

    def end_wait(self, connection: BoundedProtocol) -> None:
        """Note that a connection has a request, or is closed."""
        self.fresh.pop(connection, None)
        self.served.pop(connection, None)

    def warn(self, message: str, *values: object) -> None:
        """Log a warning, at most once in ``WARNING_INTERVAL_S``."""
        now = asyncio.get_running_loop().time()
        if now >= self._next_warning_s.get(message, now):
            self._next_warning_s[message] = now + WARNING_INTERVAL_S
            logging.getLogger(__name__).warning(message, *values)

    def handle_exception(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle an exception of the event loop. An accept without descriptors, which asyncio would report some hundred
        times a second, is logged once and closes connections without a request.
        """
        problem = context.get("exception")
        if (
            isinstance(problem, OSError)
            and problem.errno in _OUT_OF_DESCRIPTORS
            and "accept" in context.get("message", "")
        ):
            self.warn(
                "No descriptor is left for further connections (%s); raise the limit of open files.", problem.strerror
            )
            self.shed(SHED_COUNT)
        else:
            loop.default_exception_handler(context)


class BoundedProtocol(H11Protocol):
    """HTTP/1.1 protocol of one connection of a ``ConnectionLimiter``."""

    def __init__(self, limiter: ConnectionLimiter, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._limiter, self._request_timer = limiter, cast("asyncio.TimerHandle | None", None)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admit the connection of a client, or close it."""
        super().connection_made(transport)
        if self._limiter.admit(self):
            self._await_request()
        else:
            transport.abort()

    def allow_only_darkening(self) -> None:
        """Refuse every request on this connection but those that darken a dome."""
        self.app = _OnlyDarkening(self.app)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection, which is closed."""
        self._end_wait()
        self._limiter.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Receive bytes. They do not prolong the wait for a request, which ends only with a complete head."""
        super().data_received(data)
        if self.is_at_work:
            self._end_wait()

    def on_response_complete(self) -> None:
        """Wait for the next request once one was answered."""
        super().on_response_complete()
        if not self.is_at_work and not self.transport.is_closing():
            self._await_request()

    @property
    def is_at_work(self) -> bool:
        """Whether a request on this connection is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    def _await_request(self) -> None:
        self._end_wait()
        self._limiter.wait(self, is_fresh=self.cycle is None)
        self._request_timer = self.loop.call_later(self._limiter.header_s, self._close)

    def _end_wait(self) -> None:
        self._limiter.end_wait(self)
        if self._request_timer is not None:
            self._request_timer.cancel()
            self._request_timer = None

    def _close(self) -> None:
        if self.conn.trailing_data[0]:
            self.transport.write(_TOO_SLOW)
        self.transport.close()


class _OnlyDarkening:
    """An application that refuses every request but those that darken a dome."""

    def __init__(self, app: Any) -> None:
        self._app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http" and not _DARKENING.fullmatch(f"{scope['method']} {scope['path']}"):
            busy = PlatformError(
                "All connections of this server are at work, the rest are for switching a dome off; ask again later."
            )
            headers = {"Connection": "close", "Retry-After": "10"}
            await response_of(busy, scope["path"], headers)(scope, receive, send)
            return
        await self._app(scope, receive, send)


class BoundedServer(uvicorn.Server):
    """A uvicorn server whose connections belong to a ``ConnectionLimiter``."""

    def __init__(self, config: uvicorn.Config, limits: ConnectionLimits) -> None:
        self._limiter = ConnectionLimiter(limits)
        config.http = cast("Any", partial(BoundedProtocol, self._limiter))
        config.backlog = MAX_BACKLOG
        super().__init__(config)

    async def startup(self, sockets: Any = None) -> None:
        """Begin to listen, with the exception handler of the ``ConnectionLimiter``."""
        asyncio.get_running_loop().set_exception_handler(self._limiter.handle_exception)
        await super().startup(sockets)


def raise_descriptors() -> int:
    """Raise the limit of open files of this process as far as the system allows, at most to ``MAX_DESCRIPTORS``;
    returns the limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MAX_DESCRIPTORS)
    if soft < limit:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]
