"""Routes of tokens, browser sessions and the audit log. Annotations are evaluated here, because FastAPI reads them."""

from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field, SecretStr

from services.api.auth.access import Access
from services.api.auth.audit import AuditEntry, AuditLog
from services.api.auth.scopes import needs
from services.api.auth.sessions import COOKIE, Sessions
from services.api.auth.setup_links import SetupLinks
from services.api.auth.tokens import NAME, Caller, IssuedToken, Scope, Token
from services.api.http.bodies import BodyRoute, ValidatedBody
from services.api.http.problems import refusals
from services.client.errors import SetupLinkError, UnauthenticatedError
from services.core.geometry import Record
from services.core.values import Number
from services.pipeline.database import MAX_ID


class TokenRequest(Record):
    """A token to make."""

    name: str = Field(description="who or what uses it", json_schema_extra={"pattern": f"^{NAME}$"})
    scopes: tuple[Scope, ...] = Field(fail_fast=True, description="what it may do", json_schema_extra={"minItems": 1})
    expires_days: Number | None = Field(default=None, gt=0, le=36_500, description="days until it ends; null: never")
    group: str | None = Field(
        default=None,
        description="whose jobs and captures it sees and makes; null: its own alone",
        json_schema_extra={"pattern": f"^{NAME}$"},
    )


class SetupRequest(Record):
    """A setup link, as the server's log shows it."""

    secret: SecretStr = Field(max_length=200, description="what follows #/setup/ in the link")


class Session(Record):
    """Whom the server takes the caller for."""

    name: str
    scopes: tuple[Scope, ...] = Field(description="included ones too")
    is_open: bool = Field(description="whether this server asks nobody for a token")
    dark_key: str | None = Field(
        default=None,
        description=(
            "of a browser session whose token may operate the dome: sent as 'Authorization: Bearer …' and without"
            " the cookie, it darkens the dome and does nothing else"
        ),
    )


class AuditPage(Record):
    """Some rows of the audit log, newest first."""

    entries: list[AuditEntry]
    next_before: int | None = Field(description="give as 'before' to get the next page; null on the last")


def build_access_router(access: Access, audit: AuditLog, links: SetupLinks, *, secure: bool) -> APIRouter:
    """Build the routes; ``secure`` makes cookies travel over TLS only."""
    router = APIRouter(prefix="/v1", route_class=BodyRoute, responses=refusals(404, 422))

    @router.post("/tokens", status_code=201, tags=["access"], dependencies=[needs("admin")])
    def create(token_request: ValidatedBody[TokenRequest], request: Request, response: Response) -> IssuedToken:
        """Make a token. Its secret is in this answer and nowhere else."""
        issued = access.tokens.create(
            token_request.name,
            token_request.scopes,
            token_request.expires_days,
            request.scope["audited"],
            token_request.group,
        )
        response.headers["Location"] = f"/v1/tokens/{issued.id}"
        return issued

    @router.get("/tokens", tags=["access"], dependencies=[needs("admin")])
    def tokens() -> list[Token]:
        """List all tokens without their secrets, newest first."""
        return access.tokens.list()

    @router.delete("/tokens/{token_id}", tags=["access"], dependencies=[needs("admin")])
    def revoke(token_id: str, request: Request) -> Token:
        """End a token now, with the sessions and streams that it has opened."""
        return access.tokens.revoke(token_id, request.scope["audited"])

    def open_session(sessions: Sessions, token: Token, response: Response) -> str:
        value, lifetime_s = sessions.issue(token)
        response.set_cookie(
            COOKIE, value, max_age=lifetime_s, path="/v1", httponly=True, samesite="strict", secure=secure
        )
        return value

    @router.post("/setup", status_code=201, tags=["access"])
    def set_up(link: ValidatedBody[SetupRequest], request: Request, response: Response) -> IssuedToken:
        """Make the first administrator's token by the link in the server's log, which works once, and open a browser
        session for it.
        """
        if access.sessions is None:
            raise SetupLinkError("This server asks nobody for a token, so there is nothing to set up; open its page.")
        issued = links.redeem(link.secret.get_secret_value(), request.scope["audited"])
        open_session(access.sessions, issued, response)
        response.headers["Location"] = f"/v1/tokens/{issued.id}"
        return issued

    @router.get("/session", tags=["access"], dependencies=[needs("read")])
    def whoami(request: Request) -> Session:
        """Whom the server takes the caller for."""
        caller: Caller = request.scope["caller"]
        return _session(caller, access, request.cookies.get(COOKIE) if caller.by_session else None)

    @router.post("/session", tags=["access"], dependencies=[needs("read")])
    def sign_in(request: Request, response: Response) -> Session:
        """Open a browser session for the token in the Authorization header; the answer sets a cookie that scripts
        cannot read.
        """
        caller: Caller = request.scope["caller"]
        cookie = None
        if access.sessions is not None:
            if caller.token is None or caller.by_session:
                raise UnauthenticatedError(
                    "A session does not open another one; send the token itself as 'Authorization: Bearer …'."
                )
            cookie = open_session(access.sessions, caller.token, response)
        return _session(caller, access, cookie)

    @router.delete("/session", status_code=204, tags=["access"], dependencies=[needs("read")])
    def sign_out(request: Request, response: Response) -> None:
        """End the browser session, also for whoever has a copy of its cookie, and take the cookie from the browser."""
        if access.sessions is not None and (cookie := request.cookies.get(COOKIE)) is not None:
            with suppress(UnauthenticatedError):  # a session that is over already
                session = access.sessions.read(cookie)
                access.tokens.end_session(session.sha256, session.expires_s)
        response.delete_cookie(COOKIE, path="/v1", httponly=True, samesite="strict", secure=secure)

    @router.get("/audit", tags=["access"], dependencies=[needs("admin")])
    def page(
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
        before: Annotated[int | None, Query(ge=1, le=MAX_ID)] = None,
        who: str | None = None,
    ) -> AuditPage:
        """Who did what, newest first."""
        found = audit.page(limit + 1, before, who)
        return AuditPage(entries=found[:limit], next_before=found[limit - 1].id if len(found) > limit else None)

    return router


def _session(caller: Caller, access: Access, cookie: str | None) -> Session:
    sessions, key = access.sessions, None
    if sessions is not None and cookie is not None and Scope.OPERATE_DOME in caller.scopes:
        key = sessions.dark_key(sessions.read(cookie))
    return Session(name=caller.name, scopes=tuple(sorted(caller.scopes)), is_open=sessions is None, dark_key=key)
