"""A TCP proxy on loopback that cuts the connection after given numbers of bytes from the client."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

BLOCK_BYTES = 2**16


class CuttingProxy:
    """Forwards to one port; ``cuts_bytes`` count over all connections together. ``sent_bytes`` is what clients have sent through it."""

    def __init__(self, port: int, cuts_bytes: Sequence[int]) -> None:
        self._target, self._cuts = port, sorted(cuts_bytes, reverse=True)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._guard, self._open = threading.Lock(), set[socket.socket]()
        self.sent_bytes = self.cut_count = 0
        self.address = f"http://127.0.0.1:{self._listener.getsockname()[1]}"

    def accept(self) -> None:
        """Forward until closed."""
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                self._open |= {near, far}
                threading.Thread(target=self._forward, args=(near, far), daemon=True).start()
                threading.Thread(target=self._return, args=(far, near), daemon=True).start()

    def close(self) -> None:
        """Cut everything."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._open:
            _cut(connection)

    def _forward(self, near: socket.socket, far: socket.socket) -> None:
        with suppress(OSError):
            while block := near.recv(BLOCK_BYTES):
                with self._guard:
                    self.sent_bytes += len(block)
                    is_cut = bool(self._cuts) and self.sent_bytes >= self._cuts[-1]
                    if is_cut:
                        beyond = self.sent_bytes - self._cuts.pop()
                        self.cut_count += 1
                        block = block[: len(block) - beyond]
                far.sendall(block)
                if is_cut:
                    break
        _cut(near)
        _cut(far)

    def _return(self, far: socket.socket, near: socket.socket) -> None:
        with suppress(OSError):
            while block := far.recv(BLOCK_BYTES):
                near.sendall(block)
        _cut(near)
        _cut(far)


@contextmanager
def cutting(port: int, cuts_bytes: Sequence[int]) -> Iterator[CuttingProxy]:
    """A proxy for the time of the block."""
    proxy = CuttingProxy(port, cuts_bytes)
    thread = threading.Thread(target=proxy.accept)
    thread.start()
    try:
        yield proxy
    finally:
        proxy.close()
        thread.join()


def _cut(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()
