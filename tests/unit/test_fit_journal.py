"""The journal of a fit: continued by the same fit, set aside by any other."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest

from services.core.errors import FencedError
from services.tasks.journal import Journal, read_entries

HEAD = b'{"format": 2, "fingerprint": "a"}\n'


def test_a_fit_continues_its_own_journal(tmp_path: Path) -> None:
    Journal(tmp_path / "journal.json", "a").get_or_compute("x", lambda: 0.1 + 0.2)
    again = Journal(tmp_path / "journal.json", "a")
    assert (again.resumed, again.set_aside) == (1, None)
    assert again.get_or_compute("x", lambda: pytest.fail("computed twice")) == (0.1 + 0.2, False)


def test_a_journal_of_another_fit_is_neither_continued_nor_lost(tmp_path: Path) -> None:
    path = tmp_path / "journal.json"
    kept = []
    for owner in ("a", "b", "c"):
        journal = Journal(path, owner)
        assert journal.resumed == 0
        assert journal.get_or_compute("x", partial(str, owner)) == (owner, True)
        kept += [] if journal.set_aside is None else [read_entries(journal.set_aside)["x"]]
    assert kept == ["a", "b"]
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "journal-set-aside-1.json",
        "journal-set-aside-2.json",
        "journal.json",
    ]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b'{"format": 1, "entr',
        b"[1, 2]",
        b"\xff\xfe",
        b'{"format": 0, "fingerprint": "a", "entries": {"x": 1}}',
        b'{"format": 3, "fingerprint": "a"}\n',
        HEAD + b'{"key": "x", "value": 1}\n{"ke\n{"key": "y", "value": 2}\n',
    ],
)
def test_what_is_damaged_or_of_another_version_is_kept_as_it_was(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "journal.json"
    path.write_bytes(content)
    journal = Journal(path, "a")
    assert journal.resumed == 0
    assert journal.set_aside is not None
    assert journal.set_aside.read_bytes() == content


def test_an_attempt_without_the_right_to_write_moves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "journal.json"
    Journal(path, "a").get_or_compute("x", lambda: 1)

    def refuse() -> None:
        raise FencedError("Overtaken.")

    with pytest.raises(FencedError):
        Journal(path, "b", refuse)
    assert Journal(path, "a").resumed == 1


def test_a_result_is_appended_and_what_was_written_before_stays(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    journal = Journal(path, "a")
    journal.get_or_compute("x", lambda: "x" * 100)
    before, file = path.read_bytes(), path.stat().st_ino
    for key in ("y", "z"):
        journal.get_or_compute(key, lambda: [0.1])
    assert path.stat().st_ino == file, "the journal was written anew"
    assert path.read_bytes() == before + b'{"key": "y", "value": [0.1]}\n{"key": "z", "value": [0.1]}\n'


def test_a_line_that_was_cut_short_is_computed_again(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    journal = Journal(path, "a")
    for key in ("x", "y"):
        journal.get_or_compute(key, lambda key=key: key)  # type: ignore[misc]  # a default is not inferred
    whole = path.read_bytes()
    for cut in range(1, len(b'{"key": "y", "value": "y"}\n')):
        path.write_bytes(whole[:-cut])
        again = Journal(path, "a")
        assert (again.resumed, again.set_aside) == (1, None)
        assert again.get_or_compute("y", lambda: "y") == ("y", True)
        assert path.read_bytes() == whole


def test_a_result_that_the_disk_does_not_take_leaves_a_journal_that_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "journal.jsonl"
    journal = Journal(path, "a")
    journal.get_or_compute("x", lambda: 1)

    def half(journal: Journal, line: bytes) -> None:
        with journal.path.open("ab") as stream:
            stream.write(line[: len(line) // 2])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(Journal, "_append", half)
        with pytest.raises(OSError, match="No space"):
            journal.get_or_compute("y", lambda: 2)
    assert journal.get_or_compute("z", lambda: 3) == (3, True)
    assert read_entries(path) == {"x": 1, "z": 3}


def test_an_attempt_that_was_overtaken_writes_into_nobodys_journal(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    older = Journal(path, "a")
    older.get_or_compute("x", lambda: 1)
    newer = Journal(path, "a")
    newer.get_or_compute("y", lambda: 2)
    with pytest.raises(FencedError, match="taken over"):
        older.get_or_compute("z", lambda: 3)
    assert read_entries(path) == {"x": 1, "y": 2}


def test_a_journal_of_the_first_format_is_continued(tmp_path: Path) -> None:
    first = tmp_path / "journal.json"
    first.write_text(json.dumps({"format": 1, "fingerprint": "a", "entries": {"x": [0.1 + 0.2], "y": None}}))
    journal = Journal(tmp_path / "journal.jsonl", "a")
    assert journal.get_or_compute("x", lambda: pytest.fail("computed twice")) == ([0.1 + 0.2], False)
    assert journal.resumed == 2
    assert first.exists(), "nothing was added yet, and an older version may still go on with it"
    journal.get_or_compute("z", lambda: 1)
    assert read_entries(tmp_path / "journal.jsonl") == {"x": [0.1 + 0.2], "y": None, "z": 1}
    assert not first.exists()
    first.write_text(json.dumps({"format": 1, "fingerprint": "b", "entries": {}}))
    assert Journal(tmp_path / "journal.jsonl", "a").resumed == 3
