"""A TCP proxy on loopback that cuts the connection after given numbers of bytes from the client or from the server."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

BLOCK_BYTES = 2**16


class CuttingProxy:
    """Forwards connections to one port and cuts them at given totals of bytes, summed over all connections."""

    def __init__(self, port: int, cuts_bytes: Sequence[int], answer_cuts_bytes: Sequence[int]) -> None:
        self._target, self._sent, self._answered = port, _Meter(cuts_bytes), _Meter(answer_cuts_bytes)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open = set[socket.socket]()
        self.address = f"http://127.0.0.1:{self._listener.getsockname()[1]}"

    def accept(self) -> None:
        """Accept and forward connections until the proxy is closed."""
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                self._open |= {near, far}
                threading.Thread(target=_pump, args=(near, far, self._sent), daemon=True).start()
                threading.Thread(target=_pump, args=(far, near, self._answered), daemon=True).start()

    def close(self) -> None:
        """Stop listening and cut every open connection."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._open:
            _cut(connection)

    @property
    def sent_bytes(self) -> int:
        """Bytes that clients have sent through the proxy."""
        return self._sent.passed_bytes

    @property
    def cut_count(self) -> int:
        """Number of cuts so far, in both directions together."""
        return self._sent.cut_count + self._answered.cut_count


class _Meter:
    """Counts the bytes that pass in one direction, and decides where to cut them."""

    def __init__(self, cuts_bytes: Sequence[int]) -> None:
        self._cuts, self._guard, self.passed_bytes = sorted(cuts_bytes, reverse=True), threading.Lock(), 0
        self.cut_count = 0

    def passing(self, block: bytes) -> tuple[bytes, bool]:
        """Return the part of a block that may still pass, and whether the connection is cut after it."""
        with self._guard:
            self.passed_bytes += len(block)
            if not self._cuts or self.passed_bytes < self._cuts[-1]:
                return block, False
            beyond = self.passed_bytes - self._cuts.pop()
            self.cut_count += 1
            return block[: max(len(block) - beyond, 0)], True


def _pump(source: socket.socket, sink: socket.socket, meter: _Meter) -> None:
    with suppress(OSError):
        while block := source.recv(BLOCK_BYTES):
            block, is_cut = meter.passing(block)
            sink.sendall(block)
            if is_cut:
                break
    _cut(source)
    _cut(sink)


@contextmanager
def cutting(port: int, cuts_bytes: Sequence[int] = (), answer_cuts_bytes: Sequence[int] = ()) -> Iterator[CuttingProxy]:
    """Run a proxy for the time of the block; it cuts after these totals of bytes from clients and from the server."""
    proxy = CuttingProxy(port, cuts_bytes, answer_cuts_bytes)
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
