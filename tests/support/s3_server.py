"""An S3 server for tests, which records its requests and can be made to refuse requests or to lose objects."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.request import Request, urlopen

import obstore
import pytest
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
from obstore.store import S3Store
from werkzeug.serving import WSGIRequestHandler, make_server

BUCKET = "teeth"


@dataclass(frozen=True)
class Asked:
    """One request and its result."""

    method: str
    key: str
    query: str
    status: int
    bytes: int


class Quiet(WSGIRequestHandler):
    def log_request(self, *_: Any) -> None:
        """Write no log."""


@dataclass
class S3Server:
    """A running server and its requests.

    Attributes:
        asked: requests so far, oldest first.
        before: function called with method and path before a request is carried out. If it returns a status, the
            server answers with that status instead.
    """

    asked: list[Asked] = field(default_factory=list)
    before: Callable[[str, str], str | None] = lambda _method, _path: None
    port: int = 0

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def count(self, method: str, *, ending: str = "", found: bool | None = None) -> int:
        """Number of requests for objects with a method; requests on the bucket itself, such as listings, do not count.

        Args:
            ending: end of the object's key.
            found: count only requests that succeeded (True) or failed (False).
        """
        return sum(
            one.method == method and one.key != "" and one.key.endswith(ending) and found in {None, one.status < 400}
            for one in self.asked
        )

    def objects(self) -> dict[str, bytes]:
        """Everything that the bucket holds, by key."""
        from moto.core.models import DEFAULT_ACCOUNT_ID
        from moto.s3.models import s3_backends

        bucket = s3_backends[DEFAULT_ACCOUNT_ID]["aws"].buckets[BUCKET]
        return {name: key.value for name, key in bucket.keys.items()}

    def remove(self, key: str) -> None:
        """Delete an object, as if it were lost."""
        obstore.delete(S3Store(BUCKET, client_options={"allow_http": True}), key)

    def put(self, key: str, content: bytes) -> None:
        """Write an object, as if another program did."""
        obstore.put(S3Store(BUCKET, client_options={"allow_http": True}), key, content)


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """Run a server on loopback with an empty bucket for the time of the block."""
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
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    told.port = server.server_port
    try:
        for method, path in (("POST", "moto-api/reset"), ("PUT", BUCKET)):
            urlopen(Request(f"{told.endpoint}/{path}", b"", method=method)).close()
        told.asked.clear()
        yield told
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def use(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    """Set the environment variables that make this process and its children use a server."""
    for name, value in environment(endpoint).items():
        monkeypatch.setenv(name, value)


def environment(endpoint: str) -> dict[str, str]:
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "tester",
        "AWS_SECRET_ACCESS_KEY": "secret",
    }
