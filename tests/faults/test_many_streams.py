"""Event streams are counted by token and address, and requests that darken a dome have places of their own."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

from services.api.auth.tokens import Scope
from services.api.http import connections
from services.api.http.connections import BoundedServer
from services.core.settings import ConnectionLimits
from tests.support.guarded_server import guarded, make_token
from tests.support.live_server import connect

DESCRIPTORS = 64


@contextmanager
def bounded(app: Callable[..., Any], limits: ConnectionLimits) -> Iterator[int]:
    """Serve an application with bounded connections; yields the port."""
    server = BoundedServer(uvicorn.Config(app, port=0, log_level="critical", timeout_graceful_shutdown=1), limits)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            thread.join(0.01)
        yield server.servers[0].sockets[0].getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()


async def stream_or_answer(scope: Any, receive: Any, send: Any) -> None:
    """An application whose GET streams without an end, and that answers all else at once."""
    if scope["type"] != "http":
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    if scope["method"] == "GET":
        await send({"type": "http.response.body", "body": b"begun", "more_body": True})
        while (await receive())["type"] != "http.disconnect":
            pass
    await send({"type": "http.response.body", "body": b""})


def told(port: int, head: str) -> bytes:
    """The first bytes of the answer to a request on a new connection; empty where the connection is reset."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        try:
            connection.sendall(f"{head} HTTP/1.1\r\nhost: a\r\n\r\n".encode())
            return connection.recv(4096)
        except ConnectionResetError:
            return b""


@pytest.mark.attack("light", "all connections taken by streams, at the limit of open files")
def test_all_off_is_answered_while_streams_take_every_other_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "raise_descriptors", lambda: DESCRIPTORS)
    with bounded(stream_or_answer, ConnectionLimits()) as port, ExitStack() as held:
        begun = 0
        for _ in range(DESCRIPTORS):
            one = held.enter_context(socket.create_connection(("127.0.0.1", port), timeout=30))
            one.sendall(b"GET /v1/events HTTP/1.1\r\nhost: a\r\n\r\n")
            begun += one.recv(4096).startswith(b"HTTP/1.1 200")
        assert begun == 24, "half of the descriptors, less a quarter of these that is kept"
        for request in ("POST /v1/dome/off", "DELETE /v1/dome/light", "POST /v1/jobs/ab12/cancel") * 10:
            assert told(port, request).startswith(b"HTTP/1.1 200"), request
        for request in ("GET /v1/events", "GET /v1/dome/off", "POST /v1/jobs", "POST /v1/jobs/ab12/cancel/more"):
            answer = told(port, request)
            assert answer.startswith(b"HTTP/1.1 503"), request
            assert b"\r\nretry-after: 10\r\n" in answer
        # Connections that send nothing give way to a request that darkens.
        for _ in range(20):
            held.enter_context(socket.create_connection(("127.0.0.1", port), timeout=30))
        assert told(port, "POST /v1/dome/off").startswith(b"HTTP/1.1 200")


def test_a_token_and_an_address_hold_so_many_streams_and_no_more(tmp_path: Path) -> None:
    ended = threading.Event()
    limits = ConnectionLimits(streams_per_token=3, streams_per_address=4)
    with (
        guarded(tmp_path, lambda *_: ended.wait(60), connections=limits) as server,
        ExitStack() as at_the_end,
    ):
        at_the_end.callback(ended.set)
        job = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
        tokens = [make_token(tmp_path, f"reader-{number}", Scope.READ) for number in range(2)]

        def opened(stack: ExitStack, token: str, path: str) -> httpx.Response:
            client = stack.enter_context(connect(str(server.client.base_url)))
            return stack.enter_context(client.stream("GET", path, headers={"Authorization": f"Bearer {token}"}))

        with ExitStack() as held:
            paths = (f"/v1/jobs/{job}/events", f"/v1/events?job={job}", f"/v1/jobs/{job}/events")
            assert [opened(held, tokens[0], path).status_code for path in paths] == [200, 200, 200]
            for path in paths[:2]:
                refused = opened(held, tokens[0], path)
                assert (refused.status_code, refused.headers["Retry-After"]) == (429, "10")
                assert "holds 3 event streams open" in refused.read().decode()
            assert opened(held, tokens[1], paths[0]).status_code == 200
            assert "address 127.0.0.1 holds 4" in opened(held, tokens[1], paths[0]).read().decode()
        for _ in range(100):  # the server learns of closed connections a moment later
            with ExitStack() as held:
                if opened(held, tokens[0], paths[0]).status_code == 200:
                    break
        else:
            pytest.fail("closed streams kept their places")
