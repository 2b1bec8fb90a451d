"""Two that write at once: files and leases stay whole, and the newer attempt's result remains."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from services.core import store
from services.core.errors import FencedError
from services.core.geometry import Record
from services.core.store import StageWriter, open_stage, write_atomic

HEAD_START_S = 0.4
"""How long the overtaking writer is given while the other is held back; one that waits for a lock uses all of it."""


class Note(Record):
    """The result that a stage publishes here."""

    by: int


def test_two_threads_write_one_file_and_it_is_one_of_theirs(tmp_path: Path) -> None:
    path, problems = tmp_path / "file", list[BaseException]()

    def write(content: bytes) -> None:
        try:
            for _ in range(50):
                write_atomic(path, content)
        except BaseException as problem:
            problems.append(problem)

    contents = [bytes([number]) * 10_000 for number in range(4)]
    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems
    assert path.read_bytes() in contents
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError):
        write_atomic(tmp_path / "folder", b"content")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_the_newer_of_two_attempts_that_start_at_once_has_the_lease(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    newer: list[threading.Thread] = []

    def write_late(path: Path, content: bytes) -> None:
        if content == b"2":  # the older attempt has compared and is about to write
            newer.append(threading.Thread(target=StageWriter, args=(tmp_path, "fit", 3)))
            newer[0].start()
            newer[0].join(HEAD_START_S)
        write_atomic(path, content)

    monkeypatch.setattr(store, "write_atomic", write_late)
    older = StageWriter(tmp_path, "fit", 2)
    newer[0].join()
    assert (tmp_path / "fit.lease").read_text() == "3"
    with pytest.raises(FencedError):
        older.require_lease()


def test_an_attempt_that_is_overtaken_while_it_publishes_does_not_replace_the_newer_ones_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    older, newer = StageWriter(tmp_path, "fit", 1), list[threading.Thread]()
    require_lease = StageWriter.require_lease

    def overtake() -> None:
        StageWriter(tmp_path, "fit", 2).publish(Note(by=2))

    def require_then_wait(writer: StageWriter, *, starting: bool = False) -> None:
        require_lease(writer, starting=starting)
        if writer is older and not newer:
            newer.append(threading.Thread(target=overtake))
            newer[0].start()
            newer[0].join(HEAD_START_S)

    monkeypatch.setattr(StageWriter, "require_lease", require_then_wait)
    older.publish(Note(by=1))
    newer[0].join()
    assert open_stage(tmp_path, "fit", Note)[1] == Note(by=2)
