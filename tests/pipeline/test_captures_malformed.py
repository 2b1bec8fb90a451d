"""Malformed requests to the routes of captures and uploads get a problem document with a 4xx status, and no capture or
upload is opened.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.live_server import serving

few = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
scalars = (
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=20)
)
paths = st.sampled_from(
    ["capture.json", "../a.npy", "/etc/passwd", "a\0.npy", "\ud800.npy", "a.zip", "x" * 300 + ".npy"]
) | st.text(max_size=20)
sizes = st.sampled_from([0, -1, 2**53 + 1, 2**80, 1.5, "many", 2**52])
hashes = st.sampled_from(["0" * 64, "0" * 63, "G" * 64, "A" * 64, "0" * 64 + "\n"]) | st.text(max_size=70)
files = st.fixed_dictionaries(
    {"path": paths | scalars, "bytes": sizes | scalars, "sha256": hashes | scalars}
) | st.dictionaries(st.text(max_size=6), scalars)
manifests = (
    st.fixed_dictionaries(
        {"files": st.lists(files, max_size=4) | scalars}, optional={"subject": scalars, "more": scalars}
    )
    | scalars
)
header_text = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=30)
tus_headers = st.dictionaries(
    st.sampled_from(
        ["Tus-Resumable", "Upload-Offset", "Upload-Length", "Upload-Metadata", "Upload-Checksum", "Content-Type"]
    ),
    st.sampled_from(
        ["1.0.0", "0", "-1", str(2**70), "application/offset+octet-stream", "sha256 AAAA", "capture YQ==,path YQ=="]
    )
    | header_text,
)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path_factory.mktemp("data")), lambda *_: None)) as client:
        yield client


def assert_refused(answer: httpx.Response) -> None:
    assert 400 <= answer.status_code < 500 or answer.status_code == 507
    assert answer.headers["content-type"] == "application/problem+json"


@few
@given(manifest=manifests)
@pytest.mark.attack("uploads", "a malformed manifest")
def test_malformed_manifests_are_refused(client: httpx.Client, manifest: Any) -> None:
    import json

    assert_refused(
        client.post("/v1/captures", content=json.dumps(manifest), headers={"Content-Type": "application/json"})
    )
    assert client.get("/v1/captures").json()["captures"] == []


@few
@given(
    method=st.sampled_from(["POST", "PATCH", "HEAD", "DELETE"]),
    place=st.sampled_from(["", "/none/0", "/a%00/1", f"/none/{2**40}", "/none/-1"]),
    headers=tus_headers,
)
@pytest.mark.attack("uploads", "malformed requests of the upload protocol")
def test_malformed_uploads_are_refused(client: httpx.Client, method: str, place: str, headers: dict[str, str]) -> None:
    assert_refused(
        client.request(method, f"/v1/uploads{place}", headers=headers, content=b"x" if method == "PATCH" else None)
    )
