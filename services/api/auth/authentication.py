"""Middleware that decides which requests may pass to the routes, before a byte of the body is read.

It audits the requests that pass and those that it refuses.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from http import HTTPStatus
from typing import TYPE_CHECKING

import anyio
from sqlalchemy.exc import SQLAlchemyError
from starlette.requests import HTTPConnection
from starlette.responses import Response

from services.api.auth.access import Access
from services.api.auth.audit import AuditedAction, AuditLog
from services.api.auth.browser_protection import SAFE_METHODS
from services.api.auth.ownership import Ownership
from services.api.auth.scopes import LIVENESS, SETUP, RouteMatch, ScopedRoute, find_route, scoped_routes
from services.api.auth.tokens import Caller, public_id
from services.api.http.problems import MEDIA_TYPE, Problem, database_lost, response_of
from services.api.http.rate_limits import RateLimits, network_of
from services.api.http.request_log import method_of
from services.api.http.thread_pools import ThreadPool
from services.client.errors import RateError, ScopeError, UnauthenticatedError
from services.core.errors import PlatformError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

RECHECK_S = 5.0
"""Time in s after which a stream checks its token again. A stream of a revoked token ends at its first message after
this time."""


class AuthenticationMiddleware:
    """Identifies the caller and the route, applies the rate limits, compares scopes, audits, and ends streams whose
    token has ended.
    """

    def __init__(
        self,
        app: ASGIApp,
        owner: Starlette,
        access: Access,
        rate_limits: RateLimits,
        audit: AuditLog,
        audit_pool: ThreadPool,
        dark_audit_pool: ThreadPool,
    ) -> None:
        self._app, self._access, self._rate_limits = app, access, rate_limits
        # Build the table before the first request: FastAPI builds every route when the routes are first walked, which
        # takes 0.2 s.
        self._routes: Sequence[ScopedRoute] = scoped_routes(owner.routes)
        self._audit, self._audit_pool, self._dark_audit_pool = audit, audit_pool, dark_audit_pool
        self._ownership = Ownership(access.tokens.engine)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        found = find_route(self._routes, scope["method"], scope["path"]) if scope["type"] == "http" else None
        if found is None or _is_public(scope, found):
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        audited = AuditedAction(
            f"{method_of(scope)} {found.route.template if found.route else 'no route'}", _address(scope), ids=found.ids
        )
        try:
            refusal = await (
                self._setup_refusal(request, audited) if _is_setup(found) else self._refusal(request, found, audited)
            )
        except SQLAlchemyError:
            refusal = database_lost(scope["path"])
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        await self._pass(request, found.route, audited, receive, send)

    async def _refusal(self, request: HTTPConnection, found: RouteMatch, audited: AuditedAction) -> Response | None:
        """Return the answer to a request that may not pass; None if it may."""
        path, is_change = request.scope["path"], request.scope["method"] not in SAFE_METHODS
        try:
            caller = await self._access.identify(request)
        except UnauthenticatedError as problem:
            return await self._refuse_unauthenticated(request, problem, audited)
        audited.who, audited.token = caller.name, caller.token.id if caller.token else None
        if wait_s := self._rate_limits.count(audited.token or network_of(audited.address), is_change=is_change):
            return _rate_limited(
                f"Token {caller.name} asked" if caller.token else f"Address {audited.address} asked", wait_s, path
            )
        if found.route is None:
            return _not_found(found, path, request.scope["method"])
        try:
            found.route.admit(caller)
        except ScopeError as problem:
            await self._audit_pool.run(self._audit.append, audited, HTTPStatus.FORBIDDEN)
            lacking = f', scope="{found.route.needs.scope}"' if found.route.needs else ""
            return response_of(
                problem, path, {"WWW-Authenticate": f'Bearer realm="dentine", error="insufficient_scope"{lacking}'}
            )
        request.scope["caller"], request.scope["audited"] = caller, audited
        return await self._ownership_refusal(request, found.route, found.ids, caller, audited)

    async def _ownership_refusal(
        self, request: HTTPConnection, route: ScopedRoute, ids: dict[str, str], caller: Caller, audited: AuditedAction
    ) -> Response | None:
        """Return the answer to a request that names something of another owner, before anything else of the request is
        looked at; None if it may pass. The answer is the same as for something that does not exist.
        """
        named = None if caller.viewer.sees_all else self._ownership.named_in(route.template, ids)
        if named is None:
            return None
        kind, name = named
        if (owner := kind.cached_owner(name)) is None:
            owner = await self._access.lookup_pool.run(kind.find_owner, self._ownership.engine, name)
        if caller.viewer.may_see(owner):
            return None
        if _is_audited(request.scope, route):
            await self._audit_pool.run(self._audit.append, audited, HTTPStatus.NOT_FOUND)
        return response_of(kind.unknown_error(name), request.scope["path"])

    async def _setup_refusal(self, request: HTTPConnection, audited: AuditedAction) -> Response | None:
        """Return the answer to a caller with a setup link who is over the rate limit; None if the link may be tried.
        Each try counts as a request without a valid token.
        """
        audited.who, request.scope["audited"] = "setup link", audited
        if wait_s := self._rate_limits.count_refusal(network_of(audited.address)):
            await self._audit_excess(audited)
            return _rate_limited(f"Address {audited.address} asked", wait_s, request.scope["path"])
        return None

    async def _audit_excess(self, audited: AuditedAction) -> None:
        if self._rate_limits.should_audit_refusal(network_of(audited.address)):
            await self._audit_pool.run(self._audit.append, audited, HTTPStatus.TOO_MANY_REQUESTS)

    async def _refuse_unauthenticated(
        self, request: HTTPConnection, problem: UnauthenticatedError, audited: AuditedAction
    ) -> Response:
        """Answer and audit a request without a valid token. Refusals of one address are audited singly up to the rate
        limit, and by one row a minute beyond it.

        A request with a valid token never gets here.
        """
        credential = Access.credential(request)
        audited.token = public_id(credential) if credential else None
        if wait_s := self._rate_limits.count_refusal(network_of(audited.address)):
            await self._audit_excess(audited)
            return _rate_limited(f"Address {audited.address} was refused", wait_s, request.scope["path"])
        await self._audit_pool.run(self._audit.append, audited, HTTPStatus.UNAUTHORIZED)
        challenge = 'Bearer realm="dentine"' + (', error="invalid_token"' if credential else "")
        return response_of(problem, request.scope["path"], {"WWW-Authenticate": challenge})

    async def _pass(
        self, request: HTTPConnection, route: ScopedRoute | None, audited: AuditedAction, receive: Receive, send: Send
    ) -> None:
        scope = request.scope
        is_audited = _is_audited(scope, route)
        audit_pool = (
            self._dark_audit_pool
            if route is not None and route.needs is not None and route.needs.darkens
            else self._audit_pool
        )
        checked_at_s, is_over = time.monotonic(), False

        async def send_audited(message: Message) -> None:
            nonlocal checked_at_s, is_over
            if is_over:
                return
            if message["type"] == "http.response.start" and is_audited:
                audited.ids |= _created_resource(message)
                try:
                    await audit_pool.run(self._audit.append, audited, message["status"])
                except SQLAlchemyError:
                    is_over = True
                    unwritable = PlatformError(
                        "The audit log cannot be written, so nothing is handed out; check the database and its disk."
                    )
                    await response_of(unwritable, scope["path"])(scope, receive, send)
                    return
            if (
                message["type"] == "http.response.body"
                and message.get("more_body")
                and time.monotonic() - checked_at_s > RECHECK_S
            ):
                checked_at_s, is_over = time.monotonic(), not await self._is_still_authenticated(request)
                if is_over:
                    await send({"type": "http.response.body", "body": b""})
                    serving.cancel()
                    return
            await send(message)

        with anyio.CancelScope() as serving:
            try:
                await self._app(scope, receive, send_audited)
            except Exception:
                if is_audited:
                    with suppress(SQLAlchemyError):
                        await audit_pool.run(self._audit.append, audited, HTTPStatus.INTERNAL_SERVER_ERROR)
                raise

    async def _is_still_authenticated(self, request: HTTPConnection) -> bool:
        # A database that does not answer cannot say that the token has ended; the next message asks it again.
        try:
            with suppress(SQLAlchemyError):
                await self._access.identify(request)
        except UnauthenticatedError:
            return False
        return True


def _is_audited(scope: Scope, route: ScopedRoute | None) -> bool:
    return scope["method"] not in SAFE_METHODS or (
        route is not None and route.needs is not None and route.needs.audited
    )


def _is_public(scope: Scope, found: RouteMatch) -> bool:
    """Whether a request needs no caller: it asks for the liveness route, or for a path that only the static files of
    the page can answer.
    """
    if found.route is not None:
        return found.route.template == LIVENESS
    return not scope["path"].startswith("/v1/") and not found.allowed_methods


def _is_setup(found: RouteMatch) -> bool:
    return found.route is not None and found.route.template == SETUP


def _address(scope: Scope) -> str:
    return scope["client"][0] if scope.get("client") else "unknown"


def _created_resource(message: Message) -> dict[str, str]:
    location = next((value for name, value in message["headers"] if name.lower() == b"location"), None)
    return {} if location is None else {"made": location.decode("latin-1")}


def _rate_limited(who: str, wait_s: int, path: str) -> Response:
    return response_of(RateError(f"{who} too often; wait {wait_s} s."), path, {"Retry-After": str(wait_s)})


def _not_found(found: RouteMatch, path: str, method: str) -> Response:
    if found.allowed_methods:
        allowed = ", ".join(sorted(found.allowed_methods))
        problem = Problem.of(
            HTTPStatus.METHOD_NOT_ALLOWED,
            "method-not-allowed",
            f"{path} does not take {method}; it takes {allowed}.",
            path,
        )
        return Response(problem.model_dump_json(), problem.status, {"Allow": allowed}, MEDIA_TYPE)
    problem = Problem.of(
        HTTPStatus.NOT_FOUND,
        "not-found",
        f"There is nothing at {path}; GET /v1/openapi.json lists what there is.",
        path,
    )
    return Response(problem.model_dump_json(), problem.status, media_type=MEDIA_TYPE)
