"""Whatever a client sends to POST /v1/jobs and as paths, the answer is a problem document of the 4xx family and no job appears."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.api.app import create_app
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from tests.support.live_server import serving

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
options = st.dictionaries(st.sampled_from(sorted(JobSpec.model_fields)) | st.text(max_size=8), json_values, max_size=4)
bad_paths = st.text(min_size=1, max_size=20).map(lambda text: {"capture": f"/{text}/\0"})


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with serving(create_app(ServerSettings(data=tmp_path_factory.mktemp("data")))) as client:
        yield client


def assert_refused(answer: httpx.Response) -> None:
    assert 400 <= answer.status_code < 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert set(answer.json()) == {"type", "title", "status", "detail", "instance", "code"}


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(body=json_values | options | bad_paths)
def test_malformed_jobs_are_refused(client: httpx.Client, body: Any) -> None:
    assert_refused(client.post("/v1/jobs", json=body))
    assert client.get("/v1/jobs").json()["jobs"] == []


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(raw=st.binary(max_size=60))
def test_bodies_that_are_not_json_are_refused(client: httpx.Client, raw: bytes) -> None:
    assert_refused(client.post("/v1/jobs", content=raw, headers={"Content-Type": "application/json"}))


@pytest.mark.parametrize("query", ["limit=0", "limit=501", "limit=x", "before=x", "state=DONE"])
def test_malformed_queries_are_refused(client: httpx.Client, query: str) -> None:
    assert_refused(client.get(f"/v1/jobs?{query}"))


def test_a_form_is_not_a_job(client: httpx.Client) -> None:
    assert_refused(client.post("/v1/jobs", content='{"capture": "/"}', headers={"Content-Type": "text/plain"}))
