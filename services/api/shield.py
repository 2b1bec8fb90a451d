"""What every answer carries and what no request may do, as plain ASGI so that streams pass through unbuffered."""

from __future__ import annotations

import re
from collections.abc import Iterable
from http import HTTPStatus
from types import MappingProxyType
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from services.api.problems import MEDIA_TYPE, Problem

if TYPE_CHECKING:
    from starlette.datastructures import Headers
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
_ALWAYS = MappingProxyType(
    {
        "Content-Security-Policy": PAGE_POLICY,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Permissions-Policy": "camera=(), display-capture=(), geolocation=(), hid=(), microphone=(), payment=(), serial=(), usb=()",
    }
)
_YEAR_S = 365 * 86400


class Shield:
    """Adds security headers; refuses other names for this server (DNS rebinding), and changes that another site's page asks a visitor's browser to make.

    Args:
        names: of this server, as clients use them.
    """

    def __init__(self, app: ASGIApp, *, names: Iterable[str], secure: bool) -> None:
        self._app, self._names, self._secure = app, frozenset(name.strip("[] ").lower() for name in names), secure

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request; ``secure`` servers tell browsers to come by TLS only."""
        from starlette.datastructures import Headers, MutableHeaders
        from starlette.responses import Response

        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_shielded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _ALWAYS.items():
                    headers.setdefault(name, value)
                if self._secure:
                    headers.setdefault("Strict-Transport-Security", f"max-age={_YEAR_S}")
                if scope["path"].startswith("/v1/"):
                    headers["Cache-Control"] = "no-store"
            await send(message)

        asked, refusal = Headers(scope=scope), None
        if _name_of(asked.get("host", "")) not in self._names:
            detail = "This server does not go by the name in the request's Host; add it to DENTINE__SERVER__NAMES, or use another."
            refusal = Problem.of(HTTPStatus.BAD_REQUEST, "foreign-host", detail, scope["path"])
        elif scope["method"] not in SAFE_METHODS and _is_foreign(asked):
            detail = "Another site asked for this change; use the dashboard or the API itself."
            refusal = Problem.of(HTTPStatus.FORBIDDEN, "foreign-origin", detail, scope["path"])
        if refusal is not None:
            await Response(refusal.model_dump_json(), refusal.status, media_type=MEDIA_TYPE)(scope, receive, send_shielded)
            return
        await self._app(scope, receive, send_shielded)


def _name_of(host: str) -> str | None:
    match = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^][:/?#@\s]+)(:[0-9]*)?", host)
    return match[1].strip("[]").lower() if match else None


def _is_foreign(asked: Headers) -> bool:
    """Whether another site's page may be behind a change. A browser says where a change comes from; one that sends a cookie must."""
    origin, site = asked.get("origin"), asked.get("sec-fetch-site")
    if origin is not None and _host_of(origin) != asked.get("host"):
        return True
    if site not in {None, "same-origin", "none"}:
        return True
    return origin is None and site is None and "cookie" in asked and "authorization" not in asked


def _host_of(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
