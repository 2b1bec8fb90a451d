"""An S3 server for tests, which counts what it is asked and can be told to refuse, to strike or to lose objects."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import httpx
import obstore
import pytest
from moto.server import DomainDispatcherApplication, create_backend_app
from obstore.store import S3Store
from werkzeug.serving import WSGIRequestHandler, make_server

BUCKET = "teeth"


@dataclass(frozen=True)
class Asked:
    """One request and what became of it."""

    method: str
    key: str
    query: str
    status: int
    bytes: int


class Quiet(WSGIRequestHandler):
    def log_request(self, *_: Any) -> None:
        """Nothing on standard error."""


@dataclass
class S3Server:
    """What was asked so far, oldest first.

    Attributes:
        before: called with method and path before a request is done; what it returns, if anything, is the answer's
            status instead.
    """

    asked: list[Asked] = field(default_factory=list)
    before: Callable[[str, str], str | None] = lambda _method, _path: None
    port: int = 0

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def count(self, method: str, *, ending: str = "", found: bool | None = None) -> int:
        """Requests for objects by method, listings excepted."""
        return sum(
            one.method == method and one.key != "" and one.key.endswith(ending) and found in {None, one.status < 400}
            for one in self.asked
        )

    def objects(self) -> dict[str, bytes]:
        """Everything that the bucket holds, by key."""
        from moto.core import DEFAULT_ACCOUNT_ID
        from moto.s3.models import s3_backends

        bucket = s3_backends[DEFAULT_ACCOUNT_ID]["aws"].buckets[BUCKET]
        return {name: key.value for name, key in bucket.keys.items()}

    def remove(self, key: str) -> None:
        """An object gets lost."""
        obstore.delete(S3Store(BUCKET, client_options={"allow_http": True}), key)

    def put(self, key: str, content: bytes) -> None:
        """Somebody else writes an object."""
        obstore.put(S3Store(BUCKET, client_options={"allow_http": True}), key, content)


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """A server on loopback with an empty bucket."""
    served, told = DomainDispatcherApplication(create_backend_app), S3Server()

    def application(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        statuses: list[str] = []
        refused = told.before(method, path)

        def start(status: str, headers: Any, *rest: Any) -> Any:
            statuses.append(status)
            return start_response(status, headers, *rest)

        if refused is not None:
            start(refused, [("Content-Type", "application/xml")])
            body = [b"<Error><Code>Refused</Code></Error>"]
        else:
            body = list(served(environ, start))
        key = path.removeprefix(f"/{BUCKET}").removeprefix("/")
        told.asked.append(Asked(method, key, environ["QUERY_STRING"], int(statuses[-1][:3]), sum(map(len, body))))
        return body

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = make_server("127.0.0.1", 0, application, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    told.port = server.server_port
    try:
        httpx.post(f"{told.endpoint}/moto-api/reset").raise_for_status()
        httpx.put(f"{told.endpoint}/{BUCKET}").raise_for_status()
        told.asked.clear()
        yield told
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def use(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    """Let this process and its children speak to a server, as the environment of a program for S3 says."""
    for name, value in environment(endpoint).items():
        monkeypatch.setenv(name, value)


def environment(endpoint: str) -> dict[str, str]:
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "tester",
        "AWS_SECRET_ACCESS_KEY": "secret",
    }
