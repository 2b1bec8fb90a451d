"""A server that requires tokens, with one token of each scope."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI

from services.api.app import create_app
from services.api.auth.audit import AuditedAction
from services.api.auth.tokens import Scope, Tokens
from services.api.migrations import upgrade
from services.core.owners import DEFAULT_GROUP
from services.core.settings import ServerSettings
from services.pipeline.database import open_database
from tests.support.live_server import serving


def make_deed() -> AuditedAction:
    return AuditedAction("test", "command line", "local")


def make_token(
    data: Path, name: str, *scopes: Scope, database: str | None = None, group: str | None = DEFAULT_GROUP
) -> str:
    """Create a token on a data folder, as ``dentine token create --group`` does."""
    engine = open_database(database or ServerSettings(data=data).database_url)
    try:
        upgrade(engine)
        return Tokens(engine).create(name, scopes, None, make_deed(), group).token.get_secret_value()
    finally:
        engine.dispose()


@dataclass(frozen=True)
class Guarded:
    """A running server and its tokens by scope."""

    app: FastAPI
    client: httpx.Client
    tokens: Mapping[Scope, str]
    data: Path

    def ask(self, method: str, path: str, scope: Scope | None = None, **options: Any) -> httpx.Response:
        """Send a request with the token of a scope, or without a token; cookies of the answer are dropped."""
        headers = options.pop("headers", {}) | ({"Authorization": f"Bearer {self.tokens[scope]}"} if scope else {})
        answer = self.client.request(method, path, headers=headers, **options)
        self.client.cookies.clear()
        return answer


def run_nothing(*_: object) -> None:
    """Run a job that succeeds at once."""


@contextmanager
def guarded(data: Path, run: Any = run_nothing, **settings: Any) -> Iterator[Guarded]:
    """Serve a data folder with tokens for the time of the block; jobs may name any folder."""
    tokens = {scope: make_token(data, f"of-{scope}", scope) for scope in Scope}
    app = create_app(ServerSettings(data=data, access="tokens", **{"job_roots": "/", **settings}), run)
    with serving(app) as client:
        yield Guarded(app, client, tokens, data)
