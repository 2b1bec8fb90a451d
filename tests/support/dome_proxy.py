"""A TCP proxy in front of a dome, whose open connections can fall silent and which can refuse new ones."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

Address = tuple[str, int]


class Proxy:
    """Forwards TCP connections. ``silence`` stops the data on the open connections without closing them."""

    def __init__(self, target: Address) -> None:
        self._target, self._silent, self.accepted = target, set[socket.socket](), list[socket.socket]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address: Address = ("127.0.0.1", self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def silence(self) -> None:
        """Drop all further data of the open connections."""
        self._silent.update(self.accepted)

    def close(self) -> None:
        """Refuse new connections; the open ones go on."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self.accepted.append(near)
            far = socket.create_connection(self._target)
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._forward, args=(source, sink, near), daemon=True).start()

    def _forward(self, source: socket.socket, sink: socket.socket, near: socket.socket) -> None:
        with suppress(OSError), source:
            while data := source.recv(4096):
                if near not in self._silent:
                    sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)
