"""Which scope a route needs, declared beside it: ``dependencies=[needs("read")]``.

A route that declares none is closed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from fastapi import Depends, Request, params
from fastapi.routing import iter_route_contexts
from fastapi.security import HTTPBearer
from starlette.routing import Mount

from services.api.auth.tokens import Caller, Scope
from services.client.errors import ScopeError
from services.core.owners import Viewer

if TYPE_CHECKING:
    from starlette.routing import BaseRoute

LIVENESS = "/v1/health/live"
"""The one route that needs no scope: who asks it has no token, and it tells nothing."""
SETUP = "/v1/setup"
"""Takes a setup link, which stands for no caller; the gate counts and audits who comes with one."""
PAGE = "dashboard"
"""Name of the mount with the static page, which holds no data."""


class Needs(HTTPBearer):
    """Refuses callers without a scope; also what the OpenAPI description says of the route."""

    def __init__(self, scope: Scope, *, audited: bool, darkens: bool) -> None:
        super().__init__(scheme_name="token", auto_error=False)
        self.scope, self.audited, self.darkens = scope, audited, darkens

    async def __call__(self, request: Request) -> None:  # type: ignore[override]
        """Check the caller that the gate has found; the gate has refused already, unless somebody built an application
        without it.
        """
        require(request.scope.get("caller"), self.scope)


def needs(scope: str, *, audited: bool = False, darkens: bool = False) -> params.Security:
    """Declare the one scope that a route needs.

    Args:
        audited: of a route that only reads; changes always are.
        darkens: whether it darkens a dome, perhaps among other things, so that its row of the audit is written before
            those of others.
    """
    known = Scope(scope)
    return params.Security(Needs(known, audited=audited, darkens=darkens), scopes=[known])


def require(caller: Caller | None, scope: Scope) -> None:
    """Let a caller with the scope pass.

    Raises:
        ScopeError: names the missing scope.
    """
    if caller is None or scope not in caller.scopes:
        who = "a caller without a token" if caller is None else f"token {caller.name}"
        raise ScopeError(f"This needs scope '{scope}', which {who} does not have; use a token with that scope.")


async def _viewer(request: Request) -> Viewer:
    caller: Caller = request.scope["caller"]
    return caller.viewer


Asker = Annotated[Viewer, Depends(_viewer)]
"""Parameter of a handler whose answer depends on who asks. What a path names by ``job_id`` or ``capture`` the gate has
looked after already."""


@dataclass(frozen=True)
class GuardedRoute:
    """A route of the application and what it declares."""

    template: str
    methods: frozenset[str]
    pattern: re.Pattern[str]
    declared: tuple[Needs, ...]

    @property
    def needs(self) -> Needs | None:
        """The declaration, if there is exactly one."""
        return self.declared[0] if len(self.declared) == 1 else None

    def admit(self, caller: Caller) -> None:
        """Let a caller with the route's scope pass.

        Raises:
            ScopeError: the caller lacks the scope, or has a dark key and the route does more than darken, or the route
                declares none or several scopes.
        """
        if self.needs is None:
            raise ScopeError(
                f"Route {self.template} does not declare exactly one scope and is closed; declare it with needs()"
                " beside the route."
            )
        # A cancel darkens too, but it ends jobs without a dome as well.
        if caller.only_darkens and not (self.needs.darkens and self.needs.scope is Scope.OPERATE_DOME):
            raise ScopeError(
                "A session's dark key darkens the dome and does nothing else; send the session's cookie, or a token."
            )
        require(caller, self.needs.scope)


@dataclass(frozen=True)
class Found:
    """The route of a request; none where only the path is known, or nothing at all."""

    route: GuardedRoute | None
    ids: dict[str, str]
    allowed_methods: frozenset[str] = frozenset()


def guarded_routes(routes: Sequence[BaseRoute]) -> list[GuardedRoute]:
    """Every route of an application but its page, those of included routers and mounted applications too."""
    found = []
    for context in iter_route_contexts(routes):
        if isinstance(context.original_route, Mount) and context.name == PAGE:
            continue
        declared = tuple(
            one.dependency for one in getattr(context, "dependencies", ()) if isinstance(one.dependency, Needs)
        )
        found.append(
            GuardedRoute(
                context.path_format or "",
                frozenset(getattr(context, "methods", None) or ()),
                context.path_regex,
                declared,
            )
        )
    return found


def find_route(routes: Sequence[GuardedRoute], method: str, path: str) -> Found:
    """The first route that takes a request."""
    allowed: frozenset[str] = frozenset()
    for route in routes:
        if match := route.pattern.match(path):
            if method in route.methods or not route.methods:
                return Found(route, match.groupdict())
            allowed |= route.methods
    return Found(None, {}, allowed)
