"""Connections of Dask by TLS of which one that breaks takes no other with it.

OpenSSL keeps a list of errors for each thread, and Python from 3.12.9 on leaves a failed system call in it
(github.com/python/cpython/ issues/148594). The next connection that has nothing to read yet is then told of a broken
pipe that was another's, and Dask gives up its scheduler. Debian 13 has such a pair, and one peer that goes away ends
all connections of its thread there.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar

from distributed import Security

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


class LastingSocket(ssl.SSLSocket):
    """Asks again where the answer is an error that may be another connection's; its own error comes a second time."""

    def read(self, len: int = 1024, buffer: Any = None) -> Any:  # noqa: A002  # the name is the library's
        """See ``ssl.SSLSocket``; ``recv`` and ``recv_into`` read by this."""
        return _without_others_errors(super().read, len, buffer)

    def send(self, data: Any, flags: int = 0) -> int:
        """See ``ssl.SSLSocket``."""
        return _without_others_errors(super().send, data, flags)

    def do_handshake(self, block: bool = False) -> None:
        """See ``ssl.SSLSocket``."""
        _without_others_errors(super().do_handshake, block)


class LastingSecurity(Security):  # type: ignore[misc]  # distributed has no types
    """Certificates of one side, with sockets that last. It travels to workers by its name, so they have them too."""

    def get_connection_args(self, role: str) -> dict[str, Any]:
        """Called by Dask before it connects."""
        return _with_lasting_sockets(super().get_connection_args(role))

    def get_listen_args(self, role: str) -> dict[str, Any]:
        """Called by Dask before it listens."""
        return _with_lasting_sockets(super().get_listen_args(role))


def _with_lasting_sockets(arguments: dict[str, Any]) -> dict[str, Any]:
    context: ssl.SSLContext | None = arguments["ssl_context"]
    if context is not None:
        context.sslsocket_class = LastingSocket
    return arguments


def _without_others_errors(
    call: Callable[Arguments, Answer], *arguments: Arguments.args, **named: Arguments.kwargs
) -> Answer:
    try:
        return call(*arguments, **named)
    except ssl.SSLError:  # of TLS itself, or nothing to read yet; Python empties the list with it
        raise
    except OSError:
        _forget_errors()
        return call(*arguments, **named)


def _forget_errors() -> None:
    """Empty this thread's list, which Python does after ciphers that it does not know and nowhere by a call of its
    own.
    """
    with suppress(ssl.SSLError):
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).set_ciphers("UNKNOWN")
