"""A stream for log lines whose writers never wait: one thread writes the lines in order.

The program that reads a server's standard error may stall, and a disk may hang. A line that the event loop itself wrote
would then block every request, ALL OFF among them.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

MAX_WAITING_LINES = 10_000
"""Largest number of lines that wait: some 5 MB, or a minute of a busy server. Further lines are lost, and their number
is logged once there is room."""
CLOSE_S = 5.0
"""Longest time, s, that the end of the process waits for a reader that has stalled."""


class QueuedStream:
    """Takes whole lines for another stream and writes them in a thread."""

    def __init__(self, stream: TextIO, max_waiting_lines: int = MAX_WAITING_LINES) -> None:
        self._stream, self._max_waiting_lines, self._lost_lines = stream, max_waiting_lines, 0
        # Queue and lock are re-entrant, because the garbage collector may run in the middle of a write, and an object
        # that it finalises may log.
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._count_lock = threading.RLock()
        # The thread is a daemon, because a stalled reader must not keep the process from ending.
        self._thread = threading.Thread(target=self._write_lines, name="log", daemon=True)
        self._thread.start()

    def isatty(self) -> bool:
        """Whether the stream is a terminal."""
        return self._stream.isatty()

    def write(self, text: str) -> int:
        """Queue a line. After ``drain`` a line is written at once, because the process is ending."""
        if self._lines.qsize() < self._max_waiting_lines:
            self._lines.put(text)
        else:
            with self._count_lock:
                self._lost_lines += 1
        if not self._thread.is_alive():
            self._write_rest()
        return len(text)

    def flush(self) -> None:
        """Do nothing, because each line is flushed as it is written."""

    def drain(self) -> None:
        """Wait until every queued line is written, and end the thread."""
        self._lines.put(None)
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._write_rest()

    def _write_rest(self) -> None:
        """Write the lines that were queued after the end of the thread."""
        with suppress(queue.Empty):
            while True:
                self._write(self._lines.get_nowait() or "")

    def _write_lines(self) -> None:
        for line in iter(self._lines.get, None):
            self._write(line)
            if self._lines.empty():  # otherwise there might be no room for the warning itself
                self._report_lost_lines()
        self._report_lost_lines()

    def _report_lost_lines(self) -> None:
        with self._count_lock:
            count, self._lost_lines = self._lost_lines, 0
        if count:
            logging.getLogger(__name__).warning(
                "%d lines of the log were lost, as it could not be written; see what reads it.", count
            )

    def _write(self, line: str) -> None:
        with suppress(OSError, ValueError):  # the disk is full, or the reader has ended; the next line may succeed
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
