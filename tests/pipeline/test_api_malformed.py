"""Regression tests of malformed requests: each must be refused with a problem document and not fail in the server."""

from __future__ import annotations

import json
from collections.abc import Iterator

import httpx
import pytest
from pydantic import SecretStr

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.live_server import serving
from tests.support.postgres import new_database, postgres_server

JSON = {"Content-Type": "application/json"}
LARGE = 2**31
"""Number larger than any row number in Postgres."""


@pytest.fixture(scope="module", params=["sqlite", "postgres"])
def client(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    settings = ServerSettings(data=tmp_path_factory.mktemp("data"))
    if request.param == "sqlite":
        with serving(create_app(settings, lambda *_: None)) as client:
            yield client
        return
    with postgres_server() as server:
        settings = settings.model_copy(update={"database": SecretStr(new_database(server, "malformed"))})
        with serving(create_app(settings, lambda *_: None)) as client:
            yield client


def assert_refused(answer: httpx.Response, status: int, code: str) -> None:
    told = answer.json()
    assert (answer.status_code, told["status"], told["code"]) == (status, status, code)
    assert answer.headers["content-type"] == "application/problem+json"
    assert set(told) == {"type", "title", "status", "detail", "instance", "code"}


@pytest.mark.parametrize(
    "query",
    [
        "jobs?limit=0",
        "jobs?limit=501",
        "jobs?state=DONE",
        f"jobs?before={LARGE}",
        f"captures?before={LARGE}",
        f"audit?before={LARGE}",
        f"webhooks/none/deliveries?before={LARGE}",
        f"webhooks/none/deliveries/{LARGE}",
    ],
)
def test_queries_beyond_the_description_are_refused(client: httpx.Client, query: str) -> None:
    assert_refused(client.get(f"/v1/{query}"), 422, "bad-settings")


@pytest.mark.parametrize(
    "asked",
    ["jobs/{job}/logs?after={large}", "jobs/{job}/previews?after={large}", "jobs/{job}/previews/{large}/render"],
)
def test_numbers_that_no_row_has_are_refused(client: httpx.Client, asked: str) -> None:
    job = client.post("/v1/jobs", json={"capture": "/"}).json()["id"]
    assert_refused(client.get(f"/v1/{asked.format(job=job, large=LARGE)}"), 422, "bad-settings")
    assert_refused(client.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": str(LARGE)}), 422, "bad-settings")


def test_text_that_the_database_does_not_take_is_no_loss_of_it(client: httpx.Client) -> None:
    for path in ("jobs/%00", "captures/%00", "webhooks/%00", "deletions/%00"):
        answer = client.get(f"/v1/{path}")
        assert answer.status_code in {404, 422}, answer.text
    assert client.get("/v1/jobs?capture=%00").status_code in {200, 422}
    assert client.get("/v1/audit?who=%00").status_code in {200, 422}


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"{",
        b"\xff",
        b'"\\ud800"',
        b"[" * 100_000,
        b'{"capture":"/","seed":' + b"9" * 5000 + b"}",
        b'{"capture":"/","ior":NaN}',
    ],
)
def test_bodies_that_cannot_be_read_are_refused(client: httpx.Client, raw: bytes) -> None:
    assert_refused(client.post("/v1/jobs", content=raw, headers=JSON), 422, "bad-settings")


def test_a_form_is_not_a_job(client: httpx.Client) -> None:
    assert_refused(
        client.post("/v1/jobs", content='{"capture": "/"}', headers={"Content-Type": "text/plain"}), 422, "bad-settings"
    )


@pytest.mark.parametrize("capture", ["relative", "/\0", "/\ud800", "/" + "x" * 300, "/" + "x/" * 3000, "/dev/null/x"])
@pytest.mark.attack("traversal", "a capture's path that cannot be")
def test_paths_that_cannot_be_are_refused(client: httpx.Client, capture: str) -> None:
    for options in ({"capture": capture}, {"rig": {"mouth": capture}}):
        assert_refused(client.post("/v1/jobs", content=json.dumps(options), headers=JSON), 422, "bad-settings")


@pytest.mark.parametrize("name", ["x" * 300, "x%2F" * 3000, "%00", "fit%00.json"])
@pytest.mark.attack("traversal", "an artifact's name that no file can have")
def test_artifacts_that_cannot_be_are_unknown(client: httpx.Client, name: str) -> None:
    job = client.post("/v1/jobs", json={"capture": "/"}).json()["id"]
    assert_refused(client.get(f"/v1/jobs/{job}/artifacts/{name}"), 404, "job-unknown")


@pytest.mark.parametrize("origin", ["http://[", "null", "http://elsewhere.example"])
@pytest.mark.attack("cross-site", "a malformed origin")
def test_malformed_origins_are_foreign(client: httpx.Client, origin: str) -> None:
    assert_refused(client.delete("/v1/session", headers={"Origin": origin}), 403, "foreign-origin")


@pytest.mark.parametrize(
    "host",
    ["elsewhere.example", "[", "127.0.0.1.elsewhere.example", "127.0.0.1@elsewhere.example", "127.0.0.1:8000:1", ""],
)
@pytest.mark.attack("cross-site", "a malformed host")
def test_other_hosts_are_foreign(client: httpx.Client, host: str) -> None:
    assert_refused(client.get("/v1/jobs", headers={"Host": host}), 400, "foreign-host")


@pytest.mark.parametrize("host", ["LOCALHOST", "127.0.0.1:1", "[::1]:8000", "[::1]"])
def test_names_of_this_machine_are_its_own(client: httpx.Client, host: str) -> None:
    assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200


def test_a_problem_names_the_path_as_a_uri(client: httpx.Client) -> None:
    for path in ("/v1/jobs/%C3%A4%20%5C%23%3F", "/v1/%C3%A4%20%5C%23%3F"):
        assert client.get(path).json()["instance"] == path
