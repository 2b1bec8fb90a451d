"""A stream for log lines whose writers never wait: one thread hands them on, in order.

Whoever reads a server's standard error may stall, and a disk may hang. A line that is written by the event loop would then
keep everybody waiting, ALL OFF among them.
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
        self._stream, self._lost_lines, self._counting = stream, 0, threading.Lock()
        self._lines: queue.Queue[str | None] = queue.Queue(max_waiting_lines)
        # A daemon, as a stalled reader must not keep the process from ending.
        self._thread = threading.Thread(target=self._hand_on, name="log", daemon=True)
        self._thread.start()

    def isatty(self) -> bool:
        """Whether a person reads it in a terminal."""
        return self._stream.isatty()

    def write(self, text: str) -> int:
        """Queue a line; once the stream is drained it is written at once, as the process ends."""
        if not self._thread.is_alive():
            self._write(text)
            return len(text)
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            with self._counting:
                self._lost_lines += 1
        return len(text)

    def flush(self) -> None:
        """Nothing: each line is flushed as it is written."""

    def drain(self) -> None:
        """Have every line written that waits, and end the thread."""
        with suppress(queue.Full):
            self._lines.put(None, timeout=CLOSE_S)
            self._thread.join(CLOSE_S)
        while not self._thread.is_alive() and not self._lines.empty():  # what came behind the end
            self._write(self._lines.get() or "")

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
