"""Every route needs one scope, and every answer forbids caching and display inside frames."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from fastapi import APIRouter, FastAPI

from services.api.app import create_app
from services.api.auth.scopes import LIVENESS, SETUP, needs, scoped_routes
from services.api.auth.tokens import Caller, Scope
from services.core.settings import ServerSettings
from tests.support.access_requests import add_first
from tests.support.guarded_server import Guarded, guarded, run_nothing
from tests.support.live_server import serving

KNOWN_SCOPES = {
    "POST /v1/jobs": Scope.SUBMIT,
    "GET /v1/jobs": Scope.READ,
    "GET /v1/jobs/{job_id}": Scope.READ,
    "POST /v1/jobs/{job_id}/cancel": Scope.SUBMIT,
    "POST /v1/jobs/{job_id}/retry": Scope.SUBMIT,
    "GET /v1/jobs/{job_id}/events": Scope.READ,
    "GET /v1/jobs/{job_id}/artifacts/{path}": Scope.READ,
    "POST /v1/tokens": Scope.ADMIN,
    "GET /v1/tokens": Scope.ADMIN,
    "DELETE /v1/tokens/{token_id}": Scope.ADMIN,
    "GET /v1/audit": Scope.ADMIN,
    "POST /v1/session": Scope.READ,
    "GET /v1/openapi.json": Scope.READ,
    "PUT /v1/jobs/{job_id}/masks/{camera}/{light}": Scope.SUBMIT,
    "GET /v1/jobs/{job_id}/masks/{camera}/{light}": Scope.READ,
    "PUT /v1/calibrations/{name}": Scope.SUBMIT,
    "PUT /v1/jobs/{job_id}/calibration/{name}": Scope.SUBMIT,
    "GET /v1/calibrations": Scope.READ,
    "GET /v1/metrics": Scope.METRICS,
    "GET /v1/dome": Scope.OPERATE_DOME,
    "POST /v1/dome/off": Scope.OPERATE_DOME,
    "PUT /v1/dome/light": Scope.OPERATE_DOME,
    "DELETE /v1/dome/light": Scope.OPERATE_DOME,
    "POST /v1/dome/preflight": Scope.OPERATE_DOME,
}


def operations(app: FastAPI) -> list[tuple[str, str, Scope]]:
    """Method, template and declared scope of every route."""
    found = []
    for route in scoped_routes(app.routes):
        if route.template not in {LIVENESS, SETUP}:
            assert route.needs is not None, f"{route.template} declares {len(route.declared)} scopes"
            found += [(method, route.template, route.needs.scope) for method in route.methods]
    return found


@pytest.mark.attack("routes × scopes", "a route that declares no scope")
def test_every_route_declares_exactly_one_scope(server: Guarded) -> None:
    declared = {f"{method} {template}": scope for method, template, scope in operations(server.app)}
    assert len(declared) > len(KNOWN_SCOPES)
    assert {name: declared.get(name) for name in KNOWN_SCOPES} == KNOWN_SCOPES


def test_the_walk_sees_every_route_that_is_described(server: Guarded) -> None:
    app = server.app
    walked = {f"{method} {template}" for method, template, _ in operations(app)}
    described = {f"{method.upper()} {path}" for path, methods in app.openapi()["paths"].items() for method in methods}
    assert walked == described - {
        f"GET {LIVENESS}",
        f"POST {SETUP}",
    } | {"GET /v1/openapi.json"}
    for path, methods in app.openapi()["paths"].items():
        for operation in methods.values():
            assert bool(operation.get("security")) is (path not in {LIVENESS, SETUP})


@pytest.mark.attack("routes × scopes", "every route without a token and with each scope")
def test_every_route_with_every_scope(server: Guarded) -> None:
    for method, template, scope in operations(server.app):
        path = re.sub(r"{\w+}", "none", template)
        unknown = server.ask(method, path)
        assert unknown.status_code == 401, path
        assert method == "HEAD" or unknown.json()["code"] == "unauthenticated", path
        assert unknown.headers["www-authenticate"] == 'Bearer realm="dentine"'
        for held in Scope:
            answer = server.ask(method, path, held)
            if scope in held.included:
                assert answer.status_code not in {401, 403}, f"{method} {path} as {held}"
                continue
            assert answer.status_code == 403, f"{method} {path} as {held}"
            assert answer.headers["content-type"] == "application/problem+json"
            if method != "HEAD":
                assert answer.json()["code"] == "scope-missing"
                assert f"'{scope}'" in answer.json()["detail"]
            assert f'scope="{scope}"' in answer.headers["www-authenticate"]


def test_liveness_and_the_page_need_no_token(server: Guarded) -> None:
    assert server.ask("GET", LIVENESS).json()["status"] == "live"
    assert server.ask("GET", "/").status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [("GET", "/v1/nothing", 404), ("GET", "/v1/jobs/", 404), ("PUT", "/v1/jobs", 405), ("OPTIONS", "/v1/jobs", 405)],
)
@pytest.mark.attack("routes × scopes", "looking for routes without a token")
def test_what_is_not_there_is_not_told_to_strangers(server: Guarded, method: str, path: str, status: int) -> None:
    assert server.ask(method, path).status_code == 401
    answer = server.ask(method, path, Scope.READ)
    assert (answer.status_code, answer.json()["code"]) == (
        status,
        {404: "not-found", 405: "method-not-allowed"}[status],
    )
    assert answer.headers.get("allow") == {404: None, 405: "GET, POST"}[status]


@pytest.mark.attack("routes × scopes", "a route that somebody adds without a scope")
def test_a_route_that_others_add_is_open_with_exactly_one_scope(tmp_path: Path) -> None:
    called = []
    app, closed = create_app(ServerSettings(data=tmp_path), run_nothing), APIRouter()
    paths = {f"{folder}/thing-{count}": count for folder in ("/v1", "") for count in (0, 2)}
    for path, declared in paths.items():
        closed.add_api_route(path, lambda: called.append(1), dependencies=[needs("read") for _ in range(declared)])
    add_first(app, closed)
    opened = APIRouter(prefix="/v1", dependencies=[needs("read")])
    opened.add_api_route("/thing", lambda: 7)
    add_first(app, opened)
    with serving(app) as client:
        for path in paths:
            answer = client.get(path)
            assert answer.status_code == 403, path
            assert "does not declare exactly one scope" in answer.json()["detail"]
        assert client.get("/v1/thing").json() == 7
    assert not called


@pytest.mark.attack("routes × scopes", "a route behind no gate")
def test_without_the_gate_a_route_is_closed(tmp_path: Path) -> None:
    app = FastAPI()
    app.add_api_route("/thing", lambda: 1, dependencies=[needs("read")])
    app.add_middleware(_As, caller=Caller("x", frozenset({Scope.OPERATE_DOME})))
    from services.api.http import problems

    problems.install(app)
    with serving(app) as client:
        assert client.get("/thing").status_code == 403


class _As:
    def __init__(self, app: Any, caller: Caller) -> None:
        self.app, self.caller = app, caller

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        await self.app(scope | {"caller": self.caller}, receive, send)


@pytest.mark.attack("cross-site", "an answer in a cache or a frame")
def test_every_answer_of_the_api_is_kept_out_of_caches_and_frames(server: Guarded) -> None:
    job = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
    for path in (
        "/v1/jobs",
        f"/v1/jobs/{job}",
        f"/v1/jobs/{job}/events",
        f"/v1/jobs/{job}/artifacts/report.html",
        "/v1/nothing",
        "/v1/tokens",
    ):
        headers = server.ask("GET", path, Scope.READ).headers
        assert headers["cache-control"] == "no-store", path
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "camera=()" in headers["permissions-policy"]
        assert headers["cross-origin-opener-policy"] == headers["cross-origin-resource-policy"] == "same-origin"
        assert "strict-transport-security" not in headers


def test_off_loopback_browsers_are_told_to_use_tls(tmp_path: Path) -> None:
    with guarded(tmp_path, host="0.0.0.0", names="dentine.example, other.example") as server:
        answer = server.ask("POST", "/v1/session", Scope.READ, headers={"Host": "dentine.example"})
        assert answer.headers["strict-transport-security"] == "max-age=31536000"
        assert answer.headers["set-cookie"].endswith("; Secure")
        assert server.ask("GET", "/v1/jobs", Scope.READ, headers={"Host": "elsewhere.example"}).status_code == 400
