"""Middleware that adds security headers to every answer, and refuses requests that another site may be behind.

It is plain ASGI, so that streams pass through unbuffered.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import Response

from services.api.http.problems import MEDIA_TYPE, Problem

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
_HEADERS = (
    (b"content-security-policy", PAGE_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (
        b"permissions-policy",
        b"camera=(), display-capture=(), geolocation=(), hid=(), microphone=(), payment=(), serial=(), usb=()",
    ),
)
_TLS_HEADER = (b"strict-transport-security", f"max-age={365 * 86400}".encode())
_API_HEADER = (b"cache-control", b"no-store")


class BrowserProtection:
    """Adds security headers, and refuses two kinds of requests: those that address this server by a foreign name (DNS
    rebinding), and changes that the page of another site asks a visitor's browser to make.

    Args:
        names: host names and addresses of this server, as clients use them.
        secure: whether browsers are told to use TLS only.
    """

    def __init__(self, app: ASGIApp, *, names: Iterable[str], secure: bool) -> None:
        self._app, self._names = app, frozenset(name.strip("[] ").lower() for name in names)
        self._headers = (*_HEADERS, *((_TLS_HEADER,) if secure else ()))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                is_api = scope["path"].startswith("/v1/")
                own = [one for one in message["headers"] if not (is_api and one[0] == b"cache-control")]
                set_already = {name for name, _ in own}
                message["headers"] = [
                    *own,
                    *(one for one in self._headers if one[0] not in set_already),
                    *([_API_HEADER] if is_api else []),
                ]
            await send(message)

        headers, refusal = Headers(scope=scope), None
        if _name_of(headers.get("host", "")) not in self._names:
            detail = (
                "This server does not go by the name in the request's Host; add it to DENTINE__SERVER__NAMES, or use"
                " another."
            )
            refusal = Problem.of(HTTPStatus.BAD_REQUEST, "foreign-host", detail, scope["path"])
        elif scope["method"] not in SAFE_METHODS and _is_foreign(headers):
            detail = "Another site asked for this change; use the dashboard or the API itself."
            refusal = Problem.of(HTTPStatus.FORBIDDEN, "foreign-origin", detail, scope["path"])
        if refusal is not None:
            await Response(refusal.model_dump_json(), refusal.status, media_type=MEDIA_TYPE)(
                scope, receive, send_with_headers
            )
            return
        await self._app(scope, receive, send_with_headers)


def _name_of(host: str) -> str | None:
    match = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^][:/?#@\s]+)(:[0-9]*)?", host)
    return match[1].strip("[]").lower() if match else None


def _is_foreign(headers: Headers) -> bool:
    """Whether the page of another site may be behind a change.

    A browser says in Origin or Sec-Fetch-Site where a change comes from; a request with a cookie must say so.
    """
    origin, site = headers.get("origin"), headers.get("sec-fetch-site")
    if origin is not None and _host_of(origin) != headers.get("host"):
        return True
    if site not in {None, "same-origin", "none"}:
        return True
    return origin is None and site is None and "cookie" in headers and "authorization" not in headers


def _host_of(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
