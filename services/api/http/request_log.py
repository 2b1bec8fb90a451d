"""Middleware that gives every request an id and a log line, and counts it in the metrics.

It is plain ASGI, so that streams pass through unbuffered.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from typing import TYPE_CHECKING

from starlette.datastructures import Headers, MutableHeaders

from services.api.http.request_metrics import METHODS, RequestMetrics
from services.pipeline.logs import bind_request

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADER = "X-Request-ID"
UNROUTED = "unrouted"
"""Name of the route in logs and metrics for a request that no route took, so that they do not repeat what an unknown
client asked for."""

_WELL_FORMED = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


class RequestLog:
    """Logs and counts every request under its id: the client's own if it is well-formed, else a new one. The id is sent
    with the answer and kept in the request's state.
    """

    def __init__(self, app: ASGIApp, metrics: RequestMetrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        requested_id = Headers(scope=scope).get(HEADER, "")
        request_id = requested_id if _WELL_FORMED.fullmatch(requested_id) else secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id
        bind_request(request_id)
        started_s, status = time.perf_counter(), 0

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = request_id
                status = message["status"]
                self._metrics.count(scope["method"], route_of(scope), status, time.perf_counter() - started_s)
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        finally:
            duration_s = time.perf_counter() - started_s
            if not status:  # an exception, which an outer layer answers
                status = 500
                self._metrics.count(scope["method"], route_of(scope), status, duration_s)
            fields = {
                "method": method_of(scope),
                "route": route_of(scope),
                "status": status,
                "duration_s": round(duration_s, 6),
            }
            logging.getLogger(__name__).info(
                "Request answered.", extra=fields | {"client": scope["client"][0] if scope.get("client") else None}
            )


def method_of(scope: Scope) -> str:
    """Return the request's method, or ``other`` for one that HTTP does not define, as a client may send any text of any
    length.
    """
    method: str = scope["method"]
    return method if method in METHODS else "other"


def route_of(scope: Scope) -> str:
    """Return the template of the route that took the request, never its path or query."""
    return getattr(scope.get("route"), "path", None) or UNROUTED
