"""Refuses long bodies as they come in, whatever Content-Length says; plain ASGI, so that nothing is buffered."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.api.problems import response_of
from services.core.errors import BodyTooLargeError

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

EXEMPT = "/v1/uploads"
"""Uploads are long by nature and bound their own size."""


class BodyLimit:
    """Counts what is received; beyond the limit the client gets 413 and the application a disconnect."""

    def __init__(self, app: ASGIApp, limit_bytes: int) -> None:
        self._app, self._limit_bytes = app, limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["path"] == EXEMPT or scope["path"].startswith(f"{EXEMPT}/"):
            await self._app(scope, receive, send)
            return
        received_bytes, has_started, is_refused = 0, False, False

        async def refuse() -> None:
            nonlocal is_refused
            is_refused = True
            problem = BodyTooLargeError(f"A body here may have up to {self._limit_bytes} bytes; send less, or upload a capture below {EXEMPT}.")
            if not has_started:
                await response_of(problem, scope["path"], {"Connection": "close"})(scope, receive, send)

        async def receive_counted() -> Message:
            nonlocal received_bytes
            message = await receive()
            received_bytes += len(message.get("body", b""))
            if received_bytes > self._limit_bytes and not is_refused:
                await refuse()
            return {"type": "http.disconnect"} if is_refused else message

        async def send_unless_refused(message: Message) -> None:
            nonlocal has_started
            if not is_refused:
                has_started = True
                await send(message)

        if _announced_bytes(scope) > self._limit_bytes:
            await refuse()
            return
        await self._app(scope, receive_counted, send_unless_refused)


def _announced_bytes(scope: Scope) -> int:
    announced = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
    return int(announced) if announced.isdigit() else 0
