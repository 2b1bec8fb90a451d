"""What every answer carries and what no request may do, as plain ASGI so that streams pass through unbuffered."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from services.api.problems import MEDIA_TYPE, Problem

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


class Shield:
    """Adds security headers; refuses changes that another site's page asks a visitor's browser to make."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        from starlette.datastructures import Headers, MutableHeaders
        from starlette.responses import Response

        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_shielded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("Content-Security-Policy", PAGE_POLICY)
                headers.setdefault("X-Content-Type-Options", "nosniff")
                headers.setdefault("Referrer-Policy", "no-referrer")
                headers.setdefault("Cross-Origin-Resource-Policy", "same-origin")
            await send(message)

        asked = Headers(scope=scope)
        origin = asked.get("origin")
        if scope["method"] not in _SAFE_METHODS and origin is not None and urlsplit(origin).netloc != asked.get("host"):
            detail = "Another site asked for this change; use the dashboard or the API itself."
            refusal = Problem.of(HTTPStatus.FORBIDDEN, "foreign-origin", detail, scope["path"])
            await Response(refusal.model_dump_json(), 403, media_type=MEDIA_TYPE)(scope, receive, send_shielded)
            return
        await self._app(scope, receive, send_shielded)
