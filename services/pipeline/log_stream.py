"""A stream for log lines whose writers never wait: one thread hands them on, in order.

Whoever reads a server's standard error may stall, and a disk may hang. A line that is written by the event loop would
then keep everybody waiting, ALL OFF among them.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

MAX_WAITING_LINES = 10_000
"""Some 5 MB, or a minute of a busy server. Lines beyond that are lost, and how many is told once there is room."""
CLOSE_S = 5.0
"""How long the end of the process waits for a reader that has stalled."""


class QueuedStream:
    """Takes whole lines for another stream and writes them in a thread."""

    def __init__(self, stream: TextIO, max_waiting_lines: int = MAX_WAITING_LINES) -> None:
        self._stream, self._max_waiting_lines, self._lost_lines = stream, max_waiting_lines, 0
        # Both let the same thread in again: the garbage collector may run in the midst of a write, and what it ends may
        # log.
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._counting = threading.RLock()
        # A daemon, as a stalled reader must not keep the process from ending.
        self._thread = threading.Thread(target=self._hand_on, name="log", daemon=True)
        self._thread.start()

    def isatty(self) -> bool:
        """Whether a person reads it in a terminal."""
        return self._stream.isatty()

    def write(self, text: str) -> int:
        """Queue a line; once the stream is drained it is written at once, as the process ends."""
        if self._lines.qsize() < self._max_waiting_lines:
            self._lines.put(text)
        else:
            with self._counting:
                self._lost_lines += 1
        if not self._thread.is_alive():
            self._write_rest()
        return len(text)

    def flush(self) -> None:
        """Nothing: each line is flushed as it is written."""

    def drain(self) -> None:
        """Have every line written that waits, and end the thread."""
        self._lines.put(None)
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._write_rest()

    def _write_rest(self) -> None:
        """Lines that came behind the end."""
        with suppress(queue.Empty):
            while True:
                self._write(self._lines.get_nowait() or "")

    def _hand_on(self) -> None:
        for line in iter(self._lines.get, None):
            self._write(line)
            if self._lines.empty():  # else the sentence might find no room itself
                self._tell_of_lost_lines()
        self._tell_of_lost_lines()

    def _tell_of_lost_lines(self) -> None:
        with self._counting:
            count, self._lost_lines = self._lost_lines, 0
        if count:
            logging.getLogger(__name__).warning(
                "%d lines of the log were lost, as it could not be written; see what reads it.", count
            )

    def _write(self, line: str) -> None:
        with suppress(OSError, ValueError):  # a full disk, or a reader that has gone; the next line may fare better
            self._stream.write(line)
            self._stream.flush()


@contextmanager
def queued(stream: TextIO) -> Iterator[QueuedStream]:
    """A queue in front of a stream, drained however the block is left."""
    lines = QueuedStream(stream)
    try:
        yield lines
    finally:
        lines.drain()
