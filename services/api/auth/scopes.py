"""The scope that a route needs, declared beside the route: ``dependencies=[needs("read")]``.

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
"""Path of the one route that needs no scope. Its callers have no token, and it discloses nothing."""
SETUP = "/v1/setup"
"""Path of the route that takes a setup link instead of a token; the authentication middleware counts and audits its
requests."""
PAGE = "dashboard"
"""Name of the mount of the static page, which holds no data."""


class RequiredScope(HTTPBearer):
    """Dependency that refuses callers without a scope; the OpenAPI description shows it as the security of the
    route.
    """

    def __init__(self, scope: Scope, *, audited: bool, darkens: bool) -> None:
        super().__init__(scheme_name="token", auto_error=False)
        self.scope, self.audited, self.darkens = scope, audited, darkens

    async def __call__(self, request: Request) -> None:  # type: ignore[override]
        """Check the scope of the caller that the authentication middleware has identified. That middleware has checked
        the scope too; this protects an application that was built without it.
        """
        require(request.scope.get("caller"), self.scope)


def needs(scope: str, *, audited: bool = False, darkens: bool = False) -> params.Security:
    """Declare the one scope that a route needs.

    Args:
        audited: whether requests of a route that only reads are audited; changes always are.
        darkens: whether the route darkens a dome, perhaps among other effects, so that its audit row need not wait for
            those of other routes.
    """
    known = Scope(scope)
    return params.Security(RequiredScope(known, audited=audited, darkens=darkens), scopes=[known])


def require(caller: Caller | None, scope: Scope) -> None:
    """Require that a caller has a scope.

    Raises:
        ScopeError: the caller lacks it; the message names the scope.
    """
    if caller is None or scope not in caller.scopes:
        who = "a caller without a token" if caller is None else f"token {caller.name}"
        raise ScopeError(f"This needs scope '{scope}', which {who} does not have; use a token with that scope.")


async def _viewer(request: Request) -> Viewer:
    caller: Caller = request.scope["caller"]
    return caller.viewer


CurrentViewer = Annotated[Viewer, Depends(_viewer)]
"""Annotation of a handler's parameter that receives who asks. The authentication middleware has checked already whether
the caller may see what the path names by ``job_id`` or ``capture``."""


@dataclass(frozen=True)
class ScopedRoute:
    """A route of the application and the scopes that it declares."""

    template: str
    methods: frozenset[str]
    pattern: re.Pattern[str]
    declared: tuple[RequiredScope, ...]

    @property
    def needs(self) -> RequiredScope | None:
        """The declared scope; None unless there is exactly one."""
        return self.declared[0] if len(self.declared) == 1 else None

    def admit(self, caller: Caller) -> None:
        """Require that a caller has the route's scope.

        Raises:
            ScopeError: the caller lacks the scope, or has a dark key and the route does more than darken, or the route
                declares none or several scopes.
        """
        if self.needs is None:
            raise ScopeError(
                f"Route {self.template} does not declare exactly one scope and is closed; declare it with needs()"
                " beside the route."
            )
        # The route that cancels a job darkens a dome too, but is closed to a dark key, as it also ends jobs without a
        # dome.
        if caller.only_darkens and not (self.needs.darkens and self.needs.scope is Scope.OPERATE_DOME):
            raise ScopeError(
                "A session's dark key darkens the dome and does nothing else; send the session's cookie, or a token."
            )
        require(caller, self.needs.scope)


@dataclass(frozen=True)
class RouteMatch:
    """Result of looking up the route of a request. ``route`` is None where the path is known for other methods alone,
    which ``allowed_methods`` then holds, or not known at all.
    """

    route: ScopedRoute | None
    ids: dict[str, str]
    allowed_methods: frozenset[str] = frozenset()


def scoped_routes(routes: Sequence[BaseRoute]) -> list[ScopedRoute]:
    """Return every route of an application but its page, with those of included routers and mounted applications."""
    found = []
    for context in iter_route_contexts(routes):
        if isinstance(context.original_route, Mount) and context.name == PAGE:
            continue
        declared = tuple(
            one.dependency for one in getattr(context, "dependencies", ()) if isinstance(one.dependency, RequiredScope)
        )
        found.append(
            ScopedRoute(
                context.path_format or "",
                frozenset(getattr(context, "methods", None) or ()),
                context.path_regex,
                declared,
            )
        )
    return found


def find_route(routes: Sequence[ScopedRoute], method: str, path: str) -> RouteMatch:
    """Find the first route that takes a method and a path."""
    allowed: frozenset[str] = frozenset()
    for route in routes:
        if match := route.pattern.match(path):
            if method in route.methods or not route.methods:
                return RouteMatch(route, match.groupdict())
            allowed |= route.methods
    return RouteMatch(None, {}, allowed)
