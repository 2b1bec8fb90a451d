"""Every route asks for its scope, over real HTTP; nothing passes that declares none."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import APIRouter, FastAPI

from services.api.app import create_app
from services.api.auth import authentication as gate
from services.api.auth.scopes import LIVENESS, SETUP, guarded_routes, needs
from services.api.auth.sessions import COOKIE
from services.api.auth.tokens import Caller, Scope
from services.api.http import body_limit
from services.core.settings import RateSettings, ServerSettings
from tests.support.guarded_server import Guarded, guarded
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
    "GET /v1/calibrations": Scope.READ,
    "GET /v1/dome": Scope.OPERATE_DOME,
    "POST /v1/dome/off": Scope.OPERATE_DOME,
    "PUT /v1/dome/light": Scope.OPERATE_DOME,
    "DELETE /v1/dome/light": Scope.OPERATE_DOME,
    "POST /v1/dome/preflight": Scope.OPERATE_DOME,
}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    # More refusals than a test of every route makes; their limit has tests of its own.
    with guarded(tmp_path_factory.mktemp("data"), write_report, rates=RateSettings(refusals_per_minute=1000)) as server:
        yield server


def write_report(_spec: object, folder: Path, _events: object) -> None:
    (folder / "report.html").write_text("<!doctype html>")


def operations(app: FastAPI) -> list[tuple[str, str, Scope]]:
    """Method, template and declared scope of every route."""
    found = []
    for route in guarded_routes(app.routes):
        if route.template not in {LIVENESS, SETUP}:
            assert route.needs is not None, f"{route.template} declares {len(route.declared)} scopes"
            found += [(method, route.template, route.needs.scope) for method in route.methods]
    return found


@pytest.mark.attack("routes × scopes", "a route that declares no scope")
def test_every_route_declares_exactly_one_scope(tmp_path: Path) -> None:
    declared = {
        f"{method} {template}": scope
        for method, template, scope in operations(create_app(ServerSettings(data=tmp_path)))
    }
    assert len(declared) > len(KNOWN_SCOPES)
    assert {name: declared.get(name) for name in KNOWN_SCOPES} == KNOWN_SCOPES


def test_the_walk_sees_every_route_that_is_described(tmp_path: Path) -> None:
    app = create_app(ServerSettings(data=tmp_path))
    described = {f"{method.upper()} {path}" for path, methods in app.openapi()["paths"].items() for method in methods}
    assert {f"{method} {template}" for method, template, _ in operations(app)} == described - {
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


@pytest.mark.parametrize("declared", [0, 2])
@pytest.mark.parametrize("path", ["/v1/thing", "/thing"])
@pytest.mark.attack("routes × scopes", "a route that somebody adds without a scope")
def test_a_route_without_exactly_one_scope_is_closed(tmp_path: Path, declared: int, path: str) -> None:
    called = []
    router = APIRouter()
    router.add_api_route(path, lambda: called.append(1), dependencies=[needs("read") for _ in range(declared)])
    app = create_app(ServerSettings(data=tmp_path))
    add_first(app, router)
    with serving(app) as client:
        answer = client.get(path)
    assert answer.status_code == 403
    assert "does not declare exactly one scope" in answer.json()["detail"]
    assert not called


def test_a_route_that_others_add_with_one_scope_is_open(tmp_path: Path) -> None:
    router = APIRouter(prefix="/v1", dependencies=[needs("read")])
    router.add_api_route("/thing", lambda: 7)
    app = create_app(ServerSettings(data=tmp_path))
    add_first(app, router)
    with serving(app) as client:
        assert client.get("/v1/thing").json() == 7


def add_first(app: FastAPI, router: APIRouter) -> None:
    """Include a router before the page, which takes whatever is left."""
    app.include_router(router)
    app.router.routes.insert(0, app.router.routes.pop())


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


@pytest.mark.parametrize(
    "header", ["Bearer", "Basic eDp5", "Bearer dentine_0123456789ab_guess", "bearer \xff", "x" * 5000]
)
@pytest.mark.attack("tokens", "a malformed, unknown or foreign credential")
def test_a_wrong_credential_is_refused(server: Guarded, header: str) -> None:
    answer = server.client.get("/v1/jobs", headers={"Authorization": header.encode("latin-1")})
    assert (answer.status_code, answer.json()["code"]) == (401, "unauthenticated")


def test_tokens_are_made_used_listed_and_revoked_over_the_api(server: Guarded) -> None:
    made = server.ask(
        "POST", "/v1/tokens", Scope.ADMIN, json={"name": "rig-7", "scopes": ["submit"], "expires_days": 1}
    )
    assert made.status_code == 201
    assert made.headers["location"] == f"/v1/tokens/{made.json()['id']}"
    token = {"Authorization": f"Bearer {made.json()['token']}"}
    assert server.client.get("/v1/jobs", headers=token).status_code == 200
    listed = server.ask("GET", "/v1/tokens", Scope.ADMIN)
    assert "rig-7" in listed.text
    assert made.json()["token"] not in listed.text
    assert server.ask("POST", "/v1/tokens", Scope.ADMIN, json={"name": "rig-7", "scopes": ["read"]}).status_code == 422
    assert server.ask("DELETE", f"/v1/tokens/{made.json()['id']}", Scope.ADMIN).json()["revoked_s"]
    refused = server.client.get("/v1/jobs", headers=token)
    assert refused.status_code == 401
    assert 'error="invalid_token"' in refused.headers["www-authenticate"]
    assert server.ask("DELETE", "/v1/tokens/000000000000", Scope.ADMIN).json()["code"] == "token-unknown"


def sign_in(server: Guarded, scope: Scope = Scope.SUBMIT) -> dict[str, str]:
    """The cookie header of a new session."""
    answer = server.ask("POST", "/v1/session", scope)
    assert answer.status_code == 200
    set_cookie = answer.headers["set-cookie"]
    assert re.search(r"HttpOnly; Max-Age=\d+; Path=/v1; SameSite=strict$", set_cookie), set_cookie
    return {"Cookie": set_cookie.split(";")[0]}


def test_a_session_carries_the_rights_of_its_token(server: Guarded) -> None:
    cookie = sign_in(server)
    assert server.client.get("/v1/session", headers=cookie).json() == {
        "name": "of-submit",
        "scopes": ["read", "submit"],
        "is_open": False,
    }
    assert server.client.get("/v1/tokens", headers=cookie).status_code == 403
    here = cookie | {"Origin": str(server.client.base_url).rstrip("/")}
    assert server.client.post("/v1/jobs", json={"capture": "/"}, headers=here).status_code == 201
    assert server.client.post("/v1/session", headers=here).status_code == 401
    out = server.client.delete("/v1/session", headers=here)
    assert out.status_code == 204
    assert f'{COOKIE}=""' in out.headers["set-cookie"]
    assert (
        server.client.get("/v1/session", headers={"Cookie": f"{COOKIE}=dentine_0123456789ab_9999999999.00"}).status_code
        == 401
    )


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 403),
        ({"Origin": "http://elsewhere.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:9"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-origin"}, 201),
    ],
)
@pytest.mark.attack("cross-site", "a change that another site's page asks for")
def test_another_site_cannot_use_a_session(server: Guarded, headers: dict[str, str], status: int) -> None:
    answer = server.client.post("/v1/jobs", json={"capture": "/"}, headers=sign_in(server) | headers)
    assert answer.status_code == status
    if status == 403:
        assert answer.json()["code"] == "foreign-origin"


@pytest.mark.attack("tokens", "a stream and a session of a revoked token")
def test_revoking_a_token_ends_its_session_and_its_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "RECHECK_S", 0.0)
    going = tmp_path / "going"
    going.touch()

    def run(_spec: object, _folder: Path, events: Any) -> None:
        with events.open() as log:
            attempt = log.begin_stage("fit")
            while going.exists():
                from services.core.stage import StageEvent

                log.append(attempt, StageEvent(stage="fit", kind="progress"))
                time.sleep(0.02)

    with guarded(tmp_path / "data", run) as server:
        job = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
        cookie = sign_in(server, Scope.READ)
        token_id = server.tokens[Scope.READ].split("_")[1]
        try:
            with server.client.stream("GET", f"/v1/jobs/{job}/events", headers=cookie) as stream:
                lines = stream.iter_lines()
                assert any('"progress"' in line for line in lines)
                assert server.ask("DELETE", f"/v1/tokens/{token_id}", Scope.ADMIN).status_code == 200
                assert not [line for line in lines if line == "event: end"]
            assert server.ask("GET", f"/v1/jobs/{job}", Scope.SUBMIT).json()["state"] == "RUNNING"
            assert server.client.get("/v1/session", headers=cookie).status_code == 401
        finally:
            going.unlink()


@pytest.mark.parametrize("scope", [None, Scope.READ])
def test_who_asks_too_often_waits(tmp_path: Path, scope: Scope | None) -> None:
    rates = RateSettings(reads_per_10_s=5, writes_per_10_s=2, refusals_per_minute=5)
    with guarded(tmp_path, rates=rates) as server:
        answers = [server.ask("GET", "/v1/jobs", scope) for _ in range(8)]
        assert [answer.status_code for answer in answers] == [401 if scope is None else 200] * 5 + [429] * 3
        assert answers[-1].json()["code"] == "rate-limited"
        assert 1 <= int(answers[-1].headers["retry-after"]) <= 60
        assert server.ask("GET", "/v1/jobs", Scope.SUBMIT).status_code == 200
        assert server.ask("GET", LIVENESS).status_code == 200


def test_an_open_server_limits_by_address_and_writes_apart(tmp_path: Path) -> None:
    settings = ServerSettings(data=tmp_path, rates=RateSettings(reads_per_10_s=3, writes_per_10_s=2))
    with serving(create_app(settings, lambda *_: None)) as client:
        assert [client.get("/v1/options").status_code for _ in range(4)] == [200] * 3 + [429]
        assert [client.post("/v1/jobs", json={}).status_code for _ in range(3)] == [422] * 2 + [429]


def audit(server: Guarded, **query: Any) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = server.ask("GET", "/v1/audit", Scope.ADMIN, params=query).json()["entries"]
    return entries


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
    seen, before = [], None
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
    app = create_app(ServerSettings(data=tmp_path))

    def break_down() -> None:
        raise ZeroDivisionError

    router = APIRouter(prefix="/v1")
    router.add_api_route("/broken", break_down, methods=["POST"], dependencies=[needs("admin")])
    add_first(app, router)
    with serving(app) as client:
        assert client.post("/v1/broken", headers={"Connection": "close"}).json()["code"] == "internal-error"
        (row,) = client.get("/v1/audit").json()["entries"]
    assert (row["who"], row["action"], row["outcome"]) == ("local", "POST /v1/broken", 500)


LIMIT = 4096


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with guarded(tmp_path_factory.mktemp("data"), body_limit_bytes=LIMIT) as server:
        yield server


def spaced(length: int) -> bytes:
    """A job of exactly this many bytes."""
    return b'{"capture": "/"' + b" " * (length - 16) + b"}"


@pytest.mark.parametrize(("length", "status"), [(LIMIT, 201), (LIMIT + 1, 413)])
@pytest.mark.parametrize("announced", [True, False])
@pytest.mark.attack("exhaustion", "a long body, announced or not")
def test_a_body_has_a_limit(small: Guarded, length: int, status: int, announced: bool) -> None:
    body = spaced(length) if announced else iter([spaced(length)[:1000], spaced(length)[1000:]])
    answer = small.ask("POST", "/v1/jobs", Scope.SUBMIT, content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == status
    if status == 413:
        assert answer.json()["code"] == "body-too-large"
        assert f"up to {LIMIT} bytes" in answer.json()["detail"]


def raw_exchange(server: Guarded, head: str, chunks: list[bytes]) -> bytes:
    """Send bytes as they are and read until the server closes the connection."""
    import socket

    url = server.client.base_url
    with socket.create_connection((url.host, url.port), timeout=30) as connection:
        connection.sendall(head.replace("\n", "\r\n").encode())
        for chunk in chunks:
            try:
                connection.sendall(chunk)
            except (BrokenPipeError, ConnectionResetError):
                break
        answer = b""
        try:
            while piece := connection.recv(65536):
                answer += piece
        except ConnectionResetError:
            pass
        return answer


def head(server: Guarded, path: str, *more: str, scope: Scope | None = Scope.SUBMIT) -> str:
    who = [f"Authorization: Bearer {server.tokens[scope]}"] if scope else []
    return "\n".join(
        [
            f"POST {path} HTTP/1.1",
            f"Host: 127.0.0.1:{server.client.base_url.port}",
            "Content-Type: application/json",
            *who,
            *more,
            "",
            "",
        ]
    )


def test_an_announced_length_is_refused_before_a_byte_is_sent(small: Guarded) -> None:
    assert raw_exchange(small, head(small, "/v1/jobs", "Content-Length: 99999999999"), []).startswith(b"HTTP/1.1 413")


@pytest.mark.attack("exhaustion", "a body without an end")
def test_a_stream_without_end_is_refused_when_it_passes_the_limit(small: Guarded) -> None:
    """No last chunk is ever sent, so an answer proves that the server did not wait for it."""
    chunk = b"400\r\n" + b" " * 0x400 + b"\r\n"
    answer = raw_exchange(small, head(small, "/v1/jobs", "Transfer-Encoding: chunked"), [chunk] * 6)
    assert answer.startswith(b"HTTP/1.1 413")
    assert b"body-too-large" in answer


@pytest.mark.attack("exhaustion", "a body that comes a byte at a time, a stranger's with a setup link among them")
@pytest.mark.parametrize(("path", "scope"), [("/v1/jobs", Scope.SUBMIT), ("/v1/setup", None)])
def test_a_body_that_does_not_end_is_given_up(
    small: Guarded, monkeypatch: pytest.MonkeyPatch, path: str, scope: Scope | None
) -> None:
    monkeypatch.setattr(body_limit, "MAX_BODY_S", 0.3)
    answer = raw_exchange(small, head(small, path, "Content-Length: 1000", scope=scope), [b"{"])
    assert answer.startswith(b"HTTP/1.1 408")
    assert b"request-timeout" in answer


@pytest.mark.attack("exhaustion", "a stranger's body")
def test_a_stranger_is_refused_before_the_body_is_read(small: Guarded) -> None:
    answer = raw_exchange(small, head(small, "/v1/jobs", "Content-Length: 4000", "Connection: close", scope=None), [])
    assert answer.startswith(b"HTTP/1.1 401")


def test_a_route_without_body_refuses_a_long_one_before_it_acts(small: Guarded) -> None:
    before = len(audit(small, limit=500))
    answer = small.ask(
        "DELETE",
        f"/v1/tokens/{small.tokens[Scope.OPERATE_DOME].split('_')[1]}",
        Scope.ADMIN,
        content=b" " * (LIMIT + 1),
    )
    assert answer.status_code == 413
    newest = audit(small, limit=500)
    assert (len(newest), newest[0]["outcome"]) == (before + 1, 413)
    assert json.loads(small.ask("GET", "/v1/tokens", Scope.ADMIN).text)[0]["revoked_s"] is None


def test_uploads_are_exempt_by_their_path() -> None:
    from services.api.http.body_limit import EXEMPT, BodyLimit

    assert EXEMPT == "/v1/uploads"
    for path, exempt in (("/v1/uploads", True), ("/v1/uploads/x", True), ("/v1/uploadsx", False), ("/v1/jobs", False)):
        assert _status(BodyLimit(_reads_all, limit_bytes=10), path, os.urandom(11)) == (200 if exempt else 413)


async def _reads_all(_scope: Any, receive: Any, send: Any) -> None:
    while (message := await receive()).get("more_body"):
        pass
    if message["type"] == "http.request":
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})


def _status(app: Any, path: str, body: bytes) -> int:
    import asyncio

    sent: list[dict[str, Any]] = []
    pieces = [
        {"type": "http.request", "body": body[:6], "more_body": True},
        {"type": "http.request", "body": body[6:], "more_body": False},
    ]

    async def receive() -> Any:
        return pieces.pop(0)

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(
        app({"type": "http", "method": "POST", "path": path, "headers": [(b"content-length", b"1")]}, receive, send)
    )
    return int(sent[0]["status"])


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
