"""Tokens, sessions, and limits on the rate of requests."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest

from services.api.app import create_app
from services.api.auth import authentication as gate
from services.api.auth.scopes import LIVENESS, scoped_routes
from services.api.auth.sessions import COOKIE
from services.api.auth.tokens import Scope
from services.core.settings import RateSettings, ServerSettings
from tests.support.guarded_server import Guarded, guarded
from tests.support.live_server import serving


@pytest.mark.parametrize(
    "header", ["Bearer", "Basic eDp5", "Bearer dentine_0123456789ab_guess", "bearer \xff", "x" * 5000]
)
@pytest.mark.attack("tokens", "a malformed, unknown or foreign credential")
def test_a_wrong_credential_is_refused(server: Guarded, header: str) -> None:
    answer = server.client.get("/v1/jobs", headers={b"Authorization": header.encode("latin-1")})
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
    """Open a session; returns the header with its cookie."""
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
        "dark_key": None,
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


@pytest.mark.attack("tokens", "a session's dark key for anything but darkness")
def test_a_sessions_dark_key_opens_all_off_and_nothing_else(server: Guarded) -> None:
    signed_in = server.ask("POST", "/v1/session", Scope.ADMIN)
    cookie = {"Cookie": signed_in.headers["set-cookie"].split(";")[0], "Sec-Fetch-Site": "same-origin"}
    server.client.cookies.clear()
    key = signed_in.json()["dark_key"]
    assert server.client.get("/v1/session", headers=cookie).json()["dark_key"] == key
    shown = {"Authorization": f"Bearer {key}"}
    allowed = {("POST", "/v1/dome/off"), ("DELETE", "/v1/dome/light")}
    for method, path in allowed:
        assert server.client.request(method, path, headers=shown).json()["code"] == "dome-unknown", "it was let in"
    for route in scoped_routes(server.app.routes):
        path = route.template.replace("{", "").replace("}", "")
        for method in (route.methods or {"GET"}) - {"HEAD", "OPTIONS"}:
            if route.needs is not None and (method, path) not in allowed:
                assert server.client.request(method, path, headers=shown).status_code == 403, (method, path)
    assert server.client.put("/v1/dome/light", json={"light": 0}, headers=shown).status_code == 403
    forged = key.replace(key.split("_")[1], server.tokens[Scope.OPERATE_DOME].split("_")[1])
    for wrong in (
        {"Authorization": f"Bearer {forged}"},
        {"Cookie": f"{COOKIE}={key}", "Sec-Fetch-Site": "same-origin"},
    ):
        assert server.client.post("/v1/dome/off", headers=wrong).status_code == 401
    assert server.client.delete("/v1/session", headers=cookie).status_code == 204
    assert server.client.post("/v1/dome/off", headers=shown).status_code == 401, "the session is over"


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
