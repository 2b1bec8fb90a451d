"""Arrays beside a journal: the newest of a key are kept, and a crash at any point leaves those before or after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.errors import FencedError
from services.tasks.journal import Journal, read_entries


def test_arrays_take_the_place_of_those_before(tmp_path: Path) -> None:
    path = tmp_path / "slab" / "journal.jsonl"
    journal = Journal(path, "a")
    for step in range(3):
        journal.put("step", step, state=np.full(3, step / 7))
    journal.get_or_compute("x", lambda: 1)
    again = Journal(path, "a")
    assert again.entries == {"step": 2, "x": 1}
    assert np.array_equal(again.arrays("step")["state"], np.full(3, 2 / 7))
    assert len(list(path.parent.iterdir())) == 2
    again.forget("step")
    assert list(path.parent.iterdir()) == [path]
    assert read_entries(path) == {"x": 1}


@pytest.mark.parametrize("call", ["_append", "_drop_file"])
def test_a_crash_leaves_the_arrays_before_or_after(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    path = tmp_path / "journal.jsonl"
    journal = Journal(path, "a")
    journal.put("step", 0, state=np.zeros(3))

    def crash(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Journal, call, crash)
        with pytest.raises(KeyboardInterrupt):
            journal.put("step", 1, state=np.ones(3))
    again = Journal(path, "a")
    assert again.notes == []
    expected = 0 if call == "_append" else 1
    assert again.entries == {"step": expected}
    assert np.array_equal(again.arrays("step")["state"], np.full(3, float(expected)))


def test_an_attempt_that_was_overtaken_removes_no_arrays(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    older = Journal(path, "a")
    older.put("step", 0, state=np.zeros(3))
    newer = Journal(path, "a")
    newer.get_or_compute("x", lambda: 1)
    with pytest.raises(FencedError, match="taken over"):
        older.put("step", 1, state=np.ones(3))
    assert np.array_equal(Journal(path, "a").arrays("step")["state"], np.zeros(3))
