"""A TLS connection that breaks does not disturb the other connections of its thread."""

from __future__ import annotations

import pickle
import socket
import ssl
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from services.pipeline.dask_security import LastingSecurity, LastingSocket


class Link:
    """Both ends of a connection in one thread, as on a server with its own workers."""

    def __init__(self, security: LastingSecurity, stack: ExitStack) -> None:
        near, far = socket.socketpair()
        listening = security.get_listen_args("scheduler")["ssl_context"]
        connecting = security.get_connection_args("worker")["ssl_context"]
        self.server, self.client = (
            stack.enter_context(context.wrap_socket(end, server_side=is_server, do_handshake_on_connect=False))
            for context, end, is_server in ((listening, near, True), (connecting, far, False))
        )
        ends = [self.server, self.client]
        for end in ends:
            end.setblocking(False)
        for _ in range(6):
            for end in ends:
                with suppress(ssl.SSLWantReadError):
                    end.do_handshake()


@pytest.fixture(scope="module")
def security() -> LastingSecurity:
    return LastingSecurity.temporary()


@pytest.fixture
def links(security: LastingSecurity) -> Iterator[list[Link]]:
    with ExitStack() as stack:
        yield [Link(security, stack) for _ in range(2)]


def test_a_connection_whose_peer_went_away_leaves_the_others(links: list[Link]) -> None:
    broken, healthy = links
    # This is how Dask closes a connection: without the closing message of TLS.
    broken.client.shutdown(socket.SHUT_RDWR)
    with suppress(OSError):
        assert broken.server.recv(1) == b""
    for end in (healthy.server, healthy.client):
        with pytest.raises(ssl.SSLWantReadError):
            end.recv(1)
    healthy.client.send(b"still here")
    assert healthy.server.recv(64) == b"still here"


def test_an_error_of_another_connection_is_asked_about_once_more(
    links: list[Link], monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[BaseException | bytes] = [BrokenPipeError(), b"own"]

    def read(*_: object) -> bytes:
        answer = answers.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    monkeypatch.setattr(ssl.SSLSocket, "read", read)
    assert links[0].server.read(3) == b"own"
    answers[:] = [ConnectionResetError(), ConnectionResetError()]
    with pytest.raises(ConnectionResetError):
        links[0].server.read(3)
    answers[:] = [ssl.SSLWantReadError()]
    with pytest.raises(ssl.SSLWantReadError):
        links[0].server.read(3)
    assert not answers


def test_both_directions_have_such_sockets_and_workers_get_them_by_name(security: LastingSecurity) -> None:
    travelled = pickle.loads(pickle.dumps(security))
    for one in (security, travelled):
        for arguments in (one.get_listen_args("worker"), one.get_connection_args("worker")):
            assert arguments["ssl_context"].sslsocket_class is LastingSocket


def test_a_side_without_certificates_connects_without_tls() -> None:
    assert LastingSecurity().get_connection_args("client")["ssl_context"] is None
