"""The journal: continued by its own fit, set aside for any other."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest

from services.core.errors import FencedError
from services.fit.journal import Journal


def test_a_fit_continues_its_own_journal(tmp_path: Path) -> None:
    Journal(tmp_path / "journal.json", "a").once("x", lambda: 0.1 + 0.2)
    again = Journal(tmp_path / "journal.json", "a")
    assert (again.resumed, again.set_aside) == (1, None)
    assert again.once("x", lambda: pytest.fail("computed twice")) == (0.1 + 0.2, False)


def test_a_journal_of_another_fit_is_neither_continued_nor_lost(tmp_path: Path) -> None:
    path = tmp_path / "journal.json"
    kept = []
    for owner in ("a", "b", "c"):
        journal = Journal(path, owner)
        assert journal.resumed == 0
        assert journal.once("x", partial(str, owner)) == (owner, True)
        kept += [] if journal.set_aside is None else [json.loads(journal.set_aside.read_text())["entries"]["x"]]
    assert kept == ["a", "b"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["journal-set-aside-1.json", "journal-set-aside-2.json", "journal.json"]


@pytest.mark.parametrize("content", [b"", b'{"format": 1, "entr', b"[1, 2]", b"\xff\xfe", b'{"format": 0, "fingerprint": "a", "entries": {"x": 1}}'])
def test_what_is_damaged_or_of_another_version_is_kept_as_it_was(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "journal.json"
    path.write_bytes(content)
    journal = Journal(path, "a")
    assert journal.resumed == 0
    assert journal.set_aside is not None
    assert journal.set_aside.read_bytes() == content


def test_an_attempt_without_the_right_to_write_moves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "journal.json"
    Journal(path, "a").once("x", lambda: 1)

    def refuse() -> None:
        raise FencedError("Overtaken.")

    with pytest.raises(FencedError):
        Journal(path, "b", refuse)
    assert Journal(path, "a").resumed == 1
