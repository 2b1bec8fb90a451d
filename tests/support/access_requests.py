"""Requests and routes that tests of access control share, for a server that requires tokens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import APIRouter, FastAPI

from services.api.auth.tokens import Scope
from tests.support.guarded_server import Guarded


def write_report(_spec: object, folder: Path, _events: object) -> None:
    (folder / "report.html").write_text("<!doctype html>")


def add_first(app: FastAPI, router: APIRouter) -> None:
    """Include a router ahead of the dashboard's route, which matches every remaining path."""
    app.include_router(router)
    app.router.routes.insert(0, app.router.routes.pop())


def audit(server: Guarded, **query: Any) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = server.ask("GET", "/v1/audit", Scope.ADMIN, params=query).json()["entries"]
    return entries
