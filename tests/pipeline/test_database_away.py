"""While the database does not answer, a server with tokens answers 503, and open event streams stay open."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sql
from fastapi import FastAPI

from services.api.auth.tokens import Scope
from services.api.http import problems
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from tests.support.guarded_server import Guarded, guarded
from tests.support.live_server import serving


@contextmanager
def without(table: str, server: Guarded) -> Iterator[None]:
    """Hide a table from the server for the time of the block."""
    file = sql.make_url(ServerSettings(data=server.data).database_url).database
    assert file is not None
    with closing(sqlite3.connect(file)) as database:
        database.execute(f"ALTER TABLE {table} RENAME TO away")
        try:
            yield
        finally:
            database.execute(f"ALTER TABLE away RENAME TO {table}")


def problem_of(answer: httpx.Response) -> tuple[int, str]:
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    return answer.status_code, answer.json()["code"]


@pytest.mark.parametrize("credential", ["right", "wrong"])
def test_a_token_that_cannot_be_looked_up_is_neither_right_nor_wrong(tmp_path: Path, credential: str) -> None:
    with guarded(tmp_path) as server:
        token = server.tokens[Scope.READ] if credential == "right" else f"dentine_{'0' * 12}_wrong"
        with without("token", server):
            answer = server.ask("GET", "/v1/jobs", headers={"Authorization": f"Bearer {token}"})
            assert problem_of(answer) == (503, "database-lost")
        assert server.ask("GET", "/v1/jobs", headers={"Authorization": f"Bearer {token}"}).status_code == (
            200 if credential == "right" else 401
        )


def test_a_refusal_that_cannot_be_audited_is_503(tmp_path: Path) -> None:
    with guarded(tmp_path) as server, without("audit", server):
        assert problem_of(server.ask("GET", "/v1/jobs", headers={"Authorization": "Bearer wrong"})) == (
            503,
            "database-lost",
        )
        assert problem_of(server.ask("GET", "/v1/jobs")) == (503, "database-lost")
        assert problem_of(server.ask("POST", "/v1/jobs", Scope.READ, json={"capture": "/"})) == (503, "database-lost")


def test_a_stream_outlasts_the_absence_of_its_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.api.auth.authentication.RECHECK_S", 0.0)
    monkeypatch.setattr("services.api.auth.tokens.TRUSTED_S", 0.0)
    told, is_over = threading.Event(), threading.Event()

    def run(_spec: object, _folder: Path, events: Any) -> None:
        with events.open() as log:
            attempt = log.begin_stage("fit")
            while not is_over.is_set():
                if told.wait(0.05):
                    told.clear()
                    log.append(attempt, StageEvent(stage="fit", kind="progress", message="Told."))

    with guarded(tmp_path, run) as server:
        try:
            job = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
            headers = {"Authorization": f"Bearer {server.tokens[Scope.READ]}"}
            with server.client.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as stream:
                lines = stream.iter_lines()
                with without("token", server):
                    for _ in range(3):
                        told.set()
                        assert any("Told." in line for line in lines)
                is_over.set()
                assert any(line == "event: end" for line in lines)
        finally:
            is_over.set()


def test_a_server_whose_connections_are_all_taken_is_503(tmp_path: Path) -> None:
    engine = sql.create_engine(
        f"sqlite:///{tmp_path / 'some.sqlite'}", poolclass=sql.QueuePool, pool_size=1, max_overflow=0, pool_timeout=0.01
    )
    app = FastAPI()
    problems.install(app)

    @app.get("/v1/some")
    def some() -> None:
        with engine.connect(), engine.connect():
            pass

    with serving(app) as client:
        assert problem_of(client.get("/v1/some")) == (503, "database-lost")
    engine.dispose()


def test_a_method_that_nobody_knows_is_not_repeated_in_the_audit(tmp_path: Path) -> None:
    with guarded(tmp_path) as server:
        method = f"{'X' * 1000}-{server.tokens[Scope.ADMIN].rpartition('_')[2]}"
        assert server.ask(method, "/v1/jobs").status_code == 401
        entries = server.ask("GET", "/v1/audit", Scope.ADMIN).json()["entries"]
        assert [entry["action"] for entry in entries] == ["other no route", *["test"] * len(Scope)]
