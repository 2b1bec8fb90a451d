"""Middleware that refuses request bodies that are too long or too slow while they arrive, whatever Content-Length says.

It is plain ASGI, so that nothing is buffered.
"""

from __future__ import annotations

import asyncio
from http import HTTPStatus
from typing import TYPE_CHECKING

from starlette.responses import Response

from services.api.http.problems import MEDIA_TYPE, Problem, response_of
from services.client.errors import BodyTooLargeError

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

EXEMPT = "/v1/uploads"
"""Path of uploads, to which this limit does not apply: they are long by nature and limit their own size and silence."""
MAX_BODY_S = 60.0
"""Longest time from the head of a request to the end of its body, in s. A connection that is busy with a body is not
available for other requests, ALL OFF among them."""


class BodyLimit:
    """Limits the length and the duration of every request body.

    A body that is too long is answered with status 413 and one that is too slow with 408; the application then receives
    a disconnect.

    Args:
        limit_bytes: largest body, in bytes.
    """

    def __init__(self, app: ASGIApp, limit_bytes: int) -> None:
        self._app, self._limit_bytes = app, limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["path"] == EXEMPT or scope["path"].startswith(f"{EXEMPT}/"):
            await self._app(scope, receive, send)
            return
        received_bytes, has_started, is_refused, is_whole = 0, False, False, False
        until_s = asyncio.get_running_loop().time() + MAX_BODY_S

        async def refuse(refusal: Response) -> None:
            nonlocal is_refused
            is_refused = True
            if not has_started:
                await refusal(scope, receive, send)

        async def receive_counted() -> Message:
            nonlocal received_bytes, is_whole
            if is_refused:
                return {"type": "http.disconnect"}
            try:
                async with asyncio.timeout_at(None if is_whole else until_s):
                    message = await receive()
            except TimeoutError:
                await refuse(_too_slow(scope["path"]))
                return {"type": "http.disconnect"}
            received_bytes += len(message.get("body", b""))
            is_whole = not message.get("more_body", False)
            if received_bytes > self._limit_bytes:
                await refuse(self._too_long(scope["path"]))
            return {"type": "http.disconnect"} if is_refused else message

        async def send_unless_refused(message: Message) -> None:
            nonlocal has_started
            if not is_refused:
                has_started = True
                await send(message)

        if _announced_bytes(scope) > self._limit_bytes:
            await refuse(self._too_long(scope["path"]))
            return
        await self._app(scope, receive_counted, send_unless_refused)

    def _too_long(self, path: str) -> Response:
        problem = BodyTooLargeError(
            f"A body here may have up to {self._limit_bytes} bytes; send less, or upload a capture below {EXEMPT}."
        )
        return response_of(problem, path, {"Connection": "close"})


def _too_slow(path: str) -> Response:
    detail = f"The body was not whole {MAX_BODY_S:g} s after its head; send it again over a faster connection."
    problem = Problem.of(HTTPStatus.REQUEST_TIMEOUT, "request-timeout", detail, path)
    return Response(problem.model_dump_json(), problem.status, {"Connection": "close"}, MEDIA_TYPE)


def _announced_bytes(scope: Scope) -> int:
    announced = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
    return int(announced) if announced.isdigit() else 0
