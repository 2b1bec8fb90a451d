"""One light switched on by hand: its limits of level and time, and the callers who may do it."""

from __future__ import annotations

import re
import time
from pathlib import Path

import httpx
import pytest

from services.api.app import create_app
from services.api.auth.tokens import Scope
from services.api.http.problems import status_of
from services.capture.dome.controller import DomeObserver
from services.capture.dome.registers import FaultBit, FaultKind
from services.capture.dome.simulator import order_fault
from services.core.errors import RigUnreachableError
from services.core.settings import ServerSettings
from tests.support.dome_by_hand import LIGHTS, Address, console, lit, problem_of, settings_of, wait_until
from tests.support.guarded_server import guarded, run_nothing
from tests.support.live_server import serving
from tests.support.small_system import free_port


def test_one_light_goes_on_is_seen_and_goes_off(client: httpx.Client, observer: DomeObserver) -> None:
    assert client.get("/v1/dome").json()["status"]["lit"] == []
    assert client.put("/v1/dome/light", json={"light": 3, "level": 0.1, "on_s": 30}).json()["lit"] == [3]
    assert lit(observer) == (3,)
    assert client.put("/v1/dome/light", json={"light": 4, "level": 0.1, "on_s": 30}).json()["lit"] == [4]
    state = client.get("/v1/dome").json()
    assert (state["status"]["light_count"], state["status"]["lit"], state["status"]["stopped"], state["capturing"]) == (
        LIGHTS,
        [4],
        False,
        [],
    )
    assert client.delete("/v1/dome/light").json()["lit"] == []
    assert lit(observer) == ()


def test_a_light_that_nobody_asks_for_again_goes_dark(client: httpx.Client, observer: DomeObserver) -> None:
    client.put("/v1/dome/light", json={"light": 1, "on_s": 0.3})
    began_s = time.monotonic()
    client.put("/v1/dome/light", json={"light": 1, "on_s": 0.8}).raise_for_status()
    wait_until(lambda: lit(observer) == ())
    assert time.monotonic() - began_s >= 0.8, "the renewed light went dark before its time"
    # The dome's own process darkened it, not the controller's watchdog.
    assert observer.faults() == FaultBit(0)


@pytest.mark.parametrize(
    ("wanted", "named"),
    [
        ({"light": LIGHTS}, f"Light {LIGHTS} does not exist, the dome has lights 0 to {LIGHTS - 1}"),
        ({"light": -1}, "'light'"),
        ({"light": 1, "on_s": 31}, "'on_s'"),
        ({"light": 1, "level": 1.5}, "'level'"),
        ({"light": 1, "level": True}, "'level'"),
        ({"light": "1"}, "'light'"),
        ({}, "'light'"),
    ],
)
def test_a_light_that_cannot_be_is_refused_in_the_dark(
    client: httpx.Client, observer: DomeObserver, wanted: dict[str, float], named: str
) -> None:
    answer = client.put("/v1/dome/light", json=wanted)
    assert problem_of(answer) == (422, "bad-settings")
    assert named in answer.json()["detail"]
    assert lit(observer) == ()


def test_light_by_hand_adds_up_to_the_limit(shared_dome: Address, observer: DomeObserver) -> None:
    with console(shared_dome, light_exposure_limit_s=1.5) as answer:
        assert answer(do="light", light=0, level=0.1, on_s=14.9).code is None
        lit_s = time.monotonic()
        wait_until(lambda: time.monotonic() > lit_s + 0.2)
        answer(do="dark")
        # The first exposure adds at least 0.02 level-seconds to this light's dose, but none to another light's.
        assert answer(do="light", light=0, level=0.1, on_s=14.9).code == "rig-exposure-limit"
        assert lit(observer) == ()
        assert answer(do="light", light=1, level=0.1, on_s=14.9).code is None


def test_a_dome_that_does_not_answer_is_a_sentence() -> None:
    with console(("127.0.0.1", free_port())) as answer:
        for command in ("status", "off", "light"):
            told = answer(do=command, level=0.1, on_s=1)
            assert told.code == "rig-unreachable", command
            assert re.search("(check|press) (its|the)", told.message), told.message
    assert status_of(RigUnreachableError("")) == 503


def test_an_open_interlock_is_a_sentence(client: httpx.Client, shared_dome: Address) -> None:
    order_fault(*shared_dome, FaultKind.INTERLOCK_OPEN)
    assert problem_of(client.put("/v1/dome/light", json={"light": 0})) == (409, "rig-interlock")
    assert client.get("/v1/dome").json()["status"]["interlock_closed"] is False
    assert client.post("/v1/dome/off").status_code == 200


def test_a_server_without_a_dome_says_so(tmp_path: Path) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), run_nothing)) as client:
        for method, path, body in (
            ("GET", "", None),
            ("POST", "/off", None),
            ("PUT", "/light", {"light": 0}),
            ("DELETE", "/light", None),
        ):
            answer = client.request(method, f"/v1/dome{path}", json=body)
            assert problem_of(answer) == (404, "dome-unknown"), path
            assert "DENTINE__SERVER__DOME__ADDRESS" in answer.json()["detail"]


def test_without_the_packages_of_the_dome_the_server_says_so(
    shared_dome: Address, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with serving(create_app(settings_of(shared_dome, tmp_path), run_nothing)) as client:
        answer = client.get("/v1/dome")
        assert problem_of(answer) == (503, "platform-missing")
        assert "dentine[capture]" in answer.json()["detail"]


def test_the_dome_asks_for_its_scope_and_is_audited(
    shared_dome: Address, observer: DomeObserver, tmp_path: Path
) -> None:
    with guarded(tmp_path, dome=settings_of(shared_dome, tmp_path).dome) as server:
        assert server.ask("GET", "/v1/dome", Scope.OPERATE_DOME).status_code == 200
        assert server.ask("PUT", "/v1/dome/light", Scope.OPERATE_DOME, json={"light": 5}).status_code == 200
        assert problem_of(server.ask("POST", "/v1/dome/off", Scope.SUBMIT)) == (403, "scope-missing")
        assert lit(observer) == (5,)
        assert server.ask("POST", "/v1/dome/off", Scope.OPERATE_DOME).status_code == 200
        entries = server.ask("GET", "/v1/audit", Scope.ADMIN).json()["entries"]
        told = [(entry["who"], entry["action"], entry["outcome"]) for entry in entries if "/dome" in entry["action"]]
        assert told[::-1] == [
            ("of-operate-dome", "PUT /v1/dome/light", 200),
            ("of-submit", "POST /v1/dome/off", 403),
            ("of-operate-dome", "POST /v1/dome/off", 200),
        ]
