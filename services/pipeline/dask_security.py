"""TLS connections of Dask of which a broken one does not end others.

OpenSSL keeps a queue of errors for each thread, and Python from 3.12.9 on leaves the error of a failed system call in
it (github.com/python/cpython/issues/148594). The next connection of that thread that has nothing to read yet then
raises the broken pipe of another connection, and Dask gives up its scheduler. Debian 13 has such versions of both, and
there one peer that disconnects ends all connections of its thread.
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
    """A TLS socket that repeats a call whose error may be that of another connection; its own error occurs again."""

    def read(self, len: int = 1024, buffer: Any = None) -> Any:  # noqa: A002  # the name is the library's
        """See ``ssl.SSLSocket``; ``recv`` and ``recv_into`` call this method."""
        return _retry_after_foreign_error(super().read, len, buffer)

    def send(self, data: Any, flags: int = 0) -> int:
        """See ``ssl.SSLSocket``."""
        return _retry_after_foreign_error(super().send, data, flags)

    def do_handshake(self, block: bool = False) -> None:
        """See ``ssl.SSLSocket``."""
        _retry_after_foreign_error(super().do_handshake, block)


class LastingSecurity(Security):  # type: ignore[misc]  # distributed has no types
    """Dask's TLS settings of one side, with ``LastingSocket``.

    The class is sent to workers by its name, so they use such sockets too.
    """

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


def _retry_after_foreign_error(
    call: Callable[Arguments, Answer], *arguments: Arguments.args, **named: Arguments.kwargs
) -> Answer:
    try:
        return call(*arguments, **named)
    except ssl.SSLError:  # an error of TLS itself, or nothing to read yet; Python has emptied the queue
        raise
    except OSError:
        _clear_error_queue()
        return call(*arguments, **named)


def _clear_error_queue() -> None:
    """Empty this thread's queue of errors. Python does so after unknown ciphers are set, and has no call for it."""
    with suppress(ssl.SSLError):
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).set_ciphers("UNKNOWN")
