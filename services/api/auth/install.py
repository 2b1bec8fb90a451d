"""Installs the access routes and the middleware that guards the API."""

from __future__ import annotations

import sqlalchemy as sql
from fastapi import FastAPI

from services.api.auth.access import Access
from services.api.auth.audit import AuditLog
from services.api.auth.authentication import AuthenticationMiddleware
from services.api.auth.routes import build_access_router
from services.api.auth.sessions import Sessions, read_key
from services.api.auth.setup_links import SetupLinks
from services.api.auth.tokens import Tokens
from services.api.http.body_limit import BodyLimit
from services.api.http.rate_limits import RateLimits
from services.api.http.thread_pools import ThreadPool
from services.core.settings import ServerSettings


def install(
    app: FastAPI, settings: ServerSettings, engine: sql.Engine, audit_pool: ThreadPool, dark_audit_pool: ThreadPool
) -> None:
    """Add the routes of tokens, sessions and audit, and the middleware that limits bodies and authenticates all
    requests.

    Args:
        audit_pool: threads that write audit rows.
        dark_audit_pool: threads that write the audit rows of requests that darken a dome, so that their answers wait
            for no other row.
    """
    sessions = Sessions(read_key(settings.data), settings.session_s) if settings.access == "tokens" else None
    access, audit = Access(Tokens(engine), sessions), AuditLog(engine)
    app.include_router(build_access_router(access, audit, SetupLinks(engine), secure=not settings.is_loopback))
    app.add_middleware(BodyLimit, limit_bytes=settings.body_limit_bytes)
    app.add_middleware(
        AuthenticationMiddleware,
        owner=app,
        access=access,
        rate_limits=RateLimits(settings.rates),
        audit=audit,
        audit_pool=audit_pool,
        dark_audit_pool=dark_audit_pool,
    )
