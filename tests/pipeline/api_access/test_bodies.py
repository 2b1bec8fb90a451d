"""Request bodies have size limits, whether or not their length is announced."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from typing import Any

import pytest

from services.api.auth.tokens import Scope
from services.api.http import body_limit
from tests.support.access_requests import audit
from tests.support.guarded_server import Guarded, guarded

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
    """Send bytes unchanged and read until the server closes the connection; returns the answer."""
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
