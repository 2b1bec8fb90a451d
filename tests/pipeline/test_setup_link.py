"""The setup link works once, for an hour, while there is no token. Its use is rate-limited and audited, and only its
hash is stored.
"""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sql

from services.api.app import create_app
from services.api.auth.sessions import COOKIE
from services.api.auth.setup_links import LIFETIME_S, SetupLinks, setup_address
from services.api.auth.tokens import Scope
from services.api.migrations import upgrade
from services.client.errors import SetupLinkError
from services.core.settings import DATABASE_FILE, RateSettings, ServerSettings
from services.pipeline.database import open_database
from tests.support.command_line import dentine
from tests.support.guarded_server import make_deed, make_token, run_nothing
from tests.support.live_server import serving, toy_server

LINK = re.compile(r"http://127\.0\.0\.1:\d+/#/setup/([\w-]{43})")


class Clock:
    """Unix time that a test sets."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[sql.Engine]:
    engine = open_database(ServerSettings(data=tmp_path).database_url)
    upgrade(engine)
    yield engine
    engine.dispose()


@pytest.fixture
def client(tmp_path: Path) -> Iterator[httpx.Client]:
    settings = ServerSettings(data=tmp_path, access="tokens", rates=RateSettings(refusals_per_minute=5))
    with serving(create_app(settings, run_nothing)) as client:
        yield client


def secret_of(engine: sql.Engine) -> str:
    issued = SetupLinks(engine).issue()
    assert issued is not None
    return issued.get_secret_value()


@pytest.mark.attack("tokens", "a setup link, used again")
def test_a_link_makes_an_administrator_once(client: httpx.Client, engine: sql.Engine) -> None:
    secret, other = secret_of(engine), secret_of(engine)
    made = client.post("/v1/setup", json={"secret": secret})
    assert made.status_code == 201
    token = made.json()
    assert (token["name"], token["scopes"]) == ("administrator", ["admin"])
    assert "httponly" in made.headers["set-cookie"].lower()
    assert client.get("/v1/tokens", headers={"Authorization": f"Bearer {token['token']}"}).status_code == 200
    assert client.get("/v1/session").json()["name"] == "administrator"  # signed in by the cookie alone
    client.cookies.clear()
    for used in (secret, other):
        again = client.post("/v1/setup", json={"secret": used})
        assert (again.status_code, again.json()["code"]) == (403, "setup-link-void")
        assert COOKIE not in again.cookies
    rows = client.get("/v1/audit", headers={"Authorization": f"Bearer {token['token']}"}).json()["entries"]
    tries = [
        (row["who"], row["outcome"], row["ids"].get("token_id")) for row in rows if row["action"] == "POST /v1/setup"
    ]
    assert tries == [("setup link", 403, None), ("setup link", 403, None), ("setup link", 201, token["id"])]


def test_a_link_ends_after_an_hour_and_where_there_is_a_token(engine: sql.Engine, tmp_path: Path) -> None:
    clock = Clock()
    links = SetupLinks(engine, clock)
    first = links.issue()
    assert first is not None
    clock.now_s += LIFETIME_S
    with pytest.raises(SetupLinkError, match="has expired"):
        links.redeem(first.get_secret_value(), make_deed())
    second = links.issue()
    assert second is not None
    make_token(tmp_path, "laptop", Scope.READ)
    with pytest.raises(SetupLinkError):
        links.redeem(second.get_secret_value(), make_deed())
    assert links.issue() is None


def test_the_database_holds_no_secret(engine: sql.Engine, tmp_path: Path) -> None:
    secret = secret_of(engine)
    with sqlite3.connect(tmp_path / DATABASE_FILE) as connection:
        dump = "\n".join(connection.iterdump())
    connection.close()
    assert "setup_link" in dump
    assert secret not in dump


@pytest.mark.attack("tokens", "guessing a setup link")
def test_guesses_are_counted(client: httpx.Client, engine: sql.Engine) -> None:
    secret = secret_of(engine)
    answers = [client.post("/v1/setup", json={"secret": f"guess-{number}"}).status_code for number in range(8)]
    assert answers == [403] * 5 + [429] * 3
    assert client.post("/v1/setup", json={"secret": secret}).status_code == 429


@pytest.mark.parametrize("body", [{}, {"secret": 1}, {"secret": "x" * 300}, {"secret": "x", "more": 1}])
def test_what_is_no_link_is_refused(client: httpx.Client, body: dict[str, object]) -> None:
    refused = client.post("/v1/setup", json=body)
    assert (refused.status_code, refused.json()["code"]) == (422, "bad-settings")


def test_an_open_server_has_nothing_to_set_up(tmp_path: Path) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), run_nothing)) as client:
        assert "asks nobody for a token" in client.post("/v1/setup", json={"secret": "x"}).json()["detail"]


@pytest.mark.parametrize(
    ("settings", "address"),
    [
        ({}, "http://127.0.0.1:8123"),
        ({"host": "0.0.0.0"}, "http://127.0.0.1:8123"),
        ({"names": "teeth.example.org,other.example.org"}, "https://teeth.example.org"),
        ({"names": "teeth.example.org", "public_url": "http://lab:8080/"}, "http://lab:8080"),
    ],
)
def test_the_link_leads_where_people_reach_the_page(settings: dict[str, str], address: str) -> None:
    assert setup_address(ServerSettings.model_validate(settings), 8123) == address


def links_told(said: Path) -> list[str]:
    lines = [json.loads(line)["message"] for line in said.read_text().splitlines() if "/#/setup/" in line]
    assert all(line.startswith("Nobody has a token yet. Open this link within an hour") for line in lines)
    return [match[1] for line in lines if (match := LINK.search(line))]


def test_each_start_without_a_token_writes_one_link(tmp_path: Path) -> None:
    said = tmp_path / "said.txt"
    for start in range(3):
        with said.open("a") as log, toy_server(tmp_path / "data", log, access="tokens") as (client, _):
            client.get("/v1/health/live")
            links = links_told(said)
            if start == 1:
                assert client.post("/v1/setup", json={"secret": links[0]}).status_code == 201
    assert len(links) == len(set(links)) == 2


def test_an_open_server_writes_no_link(tmp_path: Path) -> None:
    said = tmp_path / "said.txt"
    with said.open("w") as log, toy_server(tmp_path / "data", log) as (client, _):
        client.get("/v1/health/live")
    assert links_told(said) == []


def test_help_names_the_setting() -> None:
    answer = dentine("jobs", DENTINE__SERVER__PUBLIC_URL="lab")
    assert answer.returncode == 2
    assert "DENTINE__SERVER__PUBLIC_URL" in answer.stderr
