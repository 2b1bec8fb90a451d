"""Log lines are written by a separate thread, so that nobody waits for a reader that stalls."""

from __future__ import annotations

import io
import logging
import os
import queue
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.api import server
from services.core.errors import SettingsError
from services.core.settings import ServerSettings
from services.pipeline.log_stream import QueuedStream, queued
from services.pipeline.logs import configure_logs

STALL_S = 2.0


class Stalled(io.StringIO):
    """Replaces a pipe or a disk that accepts nothing for a while."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.goes_on = threading.Event(), threading.Event()

    def write(self, text: str) -> int:
        self.begun.set()
        self.goes_on.wait(STALL_S)
        return super().write(text)


@pytest.fixture
def stalled() -> Iterator[Stalled]:
    """A stalled stream; the test's own logging is restored afterwards."""
    root, services = logging.getLogger(), logging.getLogger("services")
    earlier = (root.handlers, root.level, services.level)
    stream = Stalled()
    yield stream
    stream.goes_on.set()
    root.handlers, level, other = earlier
    root.setLevel(level)
    services.setLevel(other)


def test_who_logs_does_not_wait_for_a_stalled_reader_and_every_line_comes_in_order(stalled: Stalled) -> None:
    with queued(stalled) as stream:
        configure_logs(stream)
        for number in range(20):
            logging.getLogger("services.any").info("Line %d.", number)
        assert stalled.begun.wait(STALL_S)
        assert stalled.getvalue() == "", "whoever logged waited until the line was written"
        stalled.goes_on.set()
    written = stalled.getvalue().splitlines()
    assert [f"Line {number}." in line for number, line in enumerate(written)] == [True] * 20
    logging.getLogger("services.any").info("After.")
    assert "After." in stalled.getvalue(), "what is logged after the end is written all the same"


def test_lines_that_find_no_room_are_counted_and_told(stalled: Stalled) -> None:
    stream = QueuedStream(stalled, max_waiting_lines=3)
    configure_logs(stream)
    logging.getLogger("services.any").info("First.")
    assert stalled.begun.wait(STALL_S)
    for _ in range(8):
        logging.getLogger("services.any").info("Later.")
    stalled.goes_on.set()
    stream.drain()
    lines = stalled.getvalue().splitlines()
    assert sum("Later." in line for line in lines) == 3
    assert [line for line in lines if "5 lines of the log were lost" in line]


def test_what_logs_in_the_midst_of_a_write_does_not_wait_for_itself() -> None:
    # The garbage collector may run during a write, and what it deletes may log in the same thread, as asyncio's tasks
    # do.
    stream = QueuedStream(io.StringIO(), max_waiting_lines=0)
    assert isinstance(stream._lines, queue.SimpleQueue), "the only queue whose put lets its own thread in again"

    def log() -> None:
        with stream._count_lock:  # as the write holds it that finds no room
            stream.write("Within.\n")

    thread = threading.Thread(target=log, daemon=True)
    thread.start()
    thread.join(STALL_S)
    assert not thread.is_alive()
    stream.drain()


def test_the_server_writes_its_log_so_and_all_of_it_when_it_ends(
    stalled: Stalled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []

    def refuse(*_: Any) -> None:
        logging.getLogger("services.any").warning("It begins.")
        written.append(stalled.getvalue())
        stalled.goes_on.set()
        raise SettingsError("It cannot go on.")

    monkeypatch.setattr(server, "create_app", refuse)
    monkeypatch.setattr(server, "is_dashboard_built", lambda: True)
    monkeypatch.setattr(os, "umask", lambda _: 0)
    monkeypatch.setattr(sys, "stderr", stalled)
    with pytest.raises(SettingsError, match="cannot go on"):
        server.serve(ServerSettings(data=tmp_path / "data", port=0))
    assert written == [""], "the server waited for its log"
    assert "It begins." in stalled.getvalue()
