"""The audit log records the caller and the action before the answer is sent."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from fastapi import APIRouter

from services.api.app import create_app
from services.api.auth.scopes import needs
from services.api.auth.tokens import Scope
from services.core.settings import ServerSettings
from tests.support.access_requests import add_first, audit, write_report
from tests.support.guarded_server import Guarded, guarded, run_nothing
from tests.support.live_server import serving


def test_changes_refusals_and_artifacts_are_audited_and_reads_are_not(tmp_path: Path) -> None:
    with guarded(tmp_path, write_report) as server:
        base = audit(server)[0]["id"]
        job = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
        assert server.ask("GET", f"/v1/jobs/{job}/events", Scope.READ).status_code == 200
        assert server.ask("GET", "/v1/jobs", Scope.READ).status_code == 200
        server.ask("GET", f"/v1/jobs/{job}/artifacts/report.html", Scope.READ)
        server.ask("GET", f"/v1/jobs/{job}/artifacts/..%2f..%2fsession.key", Scope.READ)
        server.ask("POST", f"/v1/jobs/{job}/cancel", Scope.SUBMIT)
        server.ask("POST", "/v1/jobs", Scope.READ, json={})
        server.ask("GET", "/v1/jobs", headers={"Authorization": "Bearer dentine_0123456789ab_guessed-secret"})
        made = server.ask("POST", "/v1/tokens", Scope.ADMIN, json={"name": "rig-8", "scopes": ["read"]}).json()["id"]
        rows = [row for row in audit(server) if row["id"] > base][::-1]
        assert [(row["who"], row["action"], row["outcome"], row["ids"]) for row in rows] == [
            ("of-submit", "POST /v1/jobs", 201, {"made": f"/v1/jobs/{job}"}),
            ("of-read", "GET /v1/jobs/{job_id}/artifacts/{path}", 200, {"job_id": job, "path": "report.html"}),
            ("of-read", "GET /v1/jobs/{job_id}/artifacts/{path}", 404, {"job_id": job, "path": "../../session.key"}),
            ("of-submit", "POST /v1/jobs/{job_id}/cancel", 409, {"job_id": job}),
            ("of-read", "POST /v1/jobs", 403, {}),
            ("unknown", "GET /v1/jobs", 401, {}),
            ("of-admin", "POST /v1/tokens", 201, {"token_id": made}),
        ]
        assert {row["address"] for row in rows} == {"127.0.0.1"}
        assert rows[0]["token"] == server.tokens[Scope.SUBMIT].split("_")[1]
        assert rows[5]["token"] == "0123456789ab"
        assert all(abs(row["time_s"] - time.time()) < 600 for row in rows)
        assert [row["who"] for row in audit(server, who="of-read")] == ["of-read"] * 3


def test_the_audit_log_is_paged(server: Guarded) -> None:
    whole = audit(server, limit=500)
    seen: list[dict[str, Any]] = []
    before = None
    while len(seen) < len(whole):
        page = server.ask(
            "GET", "/v1/audit", Scope.ADMIN, params={"limit": 7} | ({"before": before} if before else {})
        ).json()
        seen += page["entries"]
        before = page["next_before"]
    assert seen == whole
    assert before is None


def test_nothing_is_handed_out_that_cannot_be_audited(tmp_path: Path) -> None:
    import sqlalchemy as sql

    from services.api.auth.audit import AuditLog

    with guarded(tmp_path, write_report) as server:
        job = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
        server.ask("GET", f"/v1/jobs/{job}/events", Scope.READ)

        def fail(*_: object) -> None:
            raise sql.exc.OperationalError("INSERT", {}, OSError("disk full"))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(AuditLog, "append", fail)
            answer = server.ask("GET", f"/v1/jobs/{job}/artifacts/report.html", Scope.READ)
        assert (answer.status_code, answer.json()["code"]) == (503, "platform-missing")
        assert "audit log cannot be written" in answer.json()["detail"]


def test_a_change_that_breaks_is_audited_as_broken(tmp_path: Path) -> None:
    app = create_app(ServerSettings(data=tmp_path), run_nothing)

    def break_down() -> None:
        raise ZeroDivisionError

    router = APIRouter(prefix="/v1")
    router.add_api_route("/broken", break_down, methods=["POST"], dependencies=[needs("admin")])
    add_first(app, router)
    with serving(app) as client:
        assert client.post("/v1/broken", headers={"Connection": "close"}).json()["code"] == "internal-error"
        (row,) = client.get("/v1/audit").json()["entries"]
    assert (row["who"], row["action"], row["outcome"]) == ("local", "POST /v1/broken", 500)
