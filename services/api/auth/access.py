"""Identifies the caller of a request."""

from __future__ import annotations

from typing import TYPE_CHECKING

from services.api.auth.sessions import COOKIE, DARK, Session, Sessions
from services.api.auth.tokens import LOCAL, Caller, Tokens
from services.api.http.thread_pools import ThreadPool
from services.client.errors import UnauthenticatedError
from services.core.errors import SettingsError
from services.core.settings import ServerSettings

if TYPE_CHECKING:
    from starlette.requests import HTTPConnection


LOOKUP_THREADS = 4
"""Number of threads that look up tokens and owners. They do nothing else, so that no disk or name server that hangs can
delay ALL OFF."""


class Access:
    """Identifies the callers of one server; ``sessions`` is None where access is open."""

    def __init__(self, tokens: Tokens, sessions: Sessions | None) -> None:
        self.tokens, self.sessions, self.lookup_pool = tokens, sessions, ThreadPool(LOOKUP_THREADS)

    async def identify(self, request: HTTPConnection) -> Caller:
        """Return the caller, identified by the Authorization header or else by the session cookie.

        Raises:
            UnauthenticatedError: the request has neither of them, or the one that it has is not valid.
        """
        if self.sessions is None:
            return LOCAL
        if (authorization := request.headers.get("authorization")) is not None:
            scheme, _, presented = authorization.partition(" ")
            if scheme.lower() != "bearer":
                raise UnauthenticatedError(
                    "This server knows no such kind of authorization; send 'Authorization: Bearer' and a token."
                )
            presented = presented.strip()
            if presented.startswith(DARK):
                return await self._of_session(self.sessions.read_dark_key(presented), only_darkens=True)
            if (token := self.tokens.trusted(presented=presented)) is None:
                token = await self.lookup_pool.run(self.tokens.authenticate, presented)
            return Caller.of(token)
        if (cookie := request.cookies.get(COOKIE)) is not None:
            return await self._of_session(self.sessions.read(cookie))
        raise UnauthenticatedError(
            "This needs a token; send it as 'Authorization: Bearer …', or sign in on the dashboard."
        )

    async def _of_session(self, session: Session, *, only_darkens: bool = False) -> Caller:
        if (token := self.tokens.trusted(session_of=session.sha256)) is None:
            token = await self.lookup_pool.run(self.tokens.authenticate_session, session.token_id, session.sha256)
        return Caller.of(token, by_session=True, only_darkens=only_darkens)

    @staticmethod
    def credential(request: HTTPConnection) -> str | None:
        """Return the token or cookie that the caller has presented, whether valid or not; None without one."""
        authorization = request.headers.get("authorization")
        return request.cookies.get(COOKIE) if authorization is None else authorization.partition(" ")[2].strip()


def refuse_open_network(settings: ServerSettings) -> None:
    """Refuse to run a server without tokens on an address that other machines can reach.

    Raises:
        SettingsError: access is open and the address is not loopback.
    """
    if settings.access == "open" and not settings.is_loopback:
        raise SettingsError(
            f"Host {settings.host} is reachable from other machines and access is open; set"
            " DENTINE__SERVER__ACCESS=tokens, or listen on 127.0.0.1."
        )
