"""A receiver of webhooks in a thread of the test, with answers that the test chooses."""

from __future__ import annotations

import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Receiver:
    """The requests received, and the status codes to answer with: ``answers`` in their order, then 204. A 0 holds the
    request open, without an answer, until ``let_go`` is set.
    """

    url: str = ""
    answers: list[int] = field(default_factory=list)
    received: list[tuple[dict[str, str], str]] = field(default_factory=list)
    let_go: threading.Event = field(default_factory=threading.Event)

    def wait(self, count: int) -> list[tuple[dict[str, str], str]]:
        """Wait for ``count`` requests; returns headers (names in lower case) and body of each request received."""
        wait_until(lambda: len(self.received) >= count)
        return self.received


def wait_until(is_true: Callable[[], bool], limit_s: float = 60.0) -> None:
    """Wait until a condition holds, and fail after a time limit."""
    end = time.monotonic() + limit_s
    while not is_true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


@contextmanager
def receiving(*answers: int, tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    """Receive on a free loopback port for the time of the block; with ``tls``, the URL's host is localhost."""
    receiver = Receiver(answers=list(answers))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers["Content-Length"])
            body = self.rfile.read(length).decode()
            if len(body) < length:
                return  # the sender was stopped in the middle
            answer = receiver.answers.pop(0) if receiver.answers else 204
            receiver.received.append(
                ({name.lower(): value for name, value in self.headers.items()} | {":path": self.path}, body)
            )
            if answer == 0:
                receiver.let_go.wait(60)
                return
            self.send_response(answer)
            if 300 <= answer < 400:
                self.send_header("Location", f"{receiver.url}/elsewhere")
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Write no log."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    receiver.url = f"http://127.0.0.1:{server.server_address[1]}"
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
        receiver.url = f"https://localhost:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield receiver
    finally:
        receiver.let_go.set()
        server.shutdown()
        thread.join()
        server.server_close()
