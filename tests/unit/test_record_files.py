"""Records by many writers: continued for the same inputs, set aside where damaged, never written without the lease."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from services.core.errors import FencedError
from services.core.geometry import Record
from services.core.store import StageWriter
from services.tasks.record_files import RecordFiles


class Done(Record):
    """A part's record."""

    pixels: int


def no_guard() -> None:
    pass


def test_records_are_those_of_their_inputs_until_they_are_removed(tmp_path: Path) -> None:
    records = RecordFiles(tmp_path / "work", no_guard)
    records.mark("a")
    pickle.loads(pickle.dumps(records)).put("0/image-1", Done(pixels=3))
    again = RecordFiles(tmp_path / "work", no_guard)
    assert (again.are_of("a"), again.are_of("b")) == (True, False)
    assert again.get("0/image-1", Done) == Done(pixels=3)
    assert again.get("0/image-2", Done) is None
    again.remove()
    assert not again.are_of("a")
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize("content", [b"", b'{"pix', b"\xff", b'{"pixels": "many"}'])
def test_a_damaged_record_is_set_aside_with_a_word(tmp_path: Path, content: bytes) -> None:
    records = RecordFiles(tmp_path, no_guard)
    for light in (1, 2):
        records.put(f"0/image-{light}", Done(pixels=light))
    (tmp_path / "0" / "image-1.json").write_bytes(content)
    (tmp_path / "0" / "other.json").write_bytes(content)
    assert records.set_damaged_aside({"image": Done}) == [
        "The record 0/image-1.json is damaged: it is kept as image-1.json-set-aside-1, and its part is made again."
    ]
    assert (tmp_path / "0" / "image-1.json-set-aside-1").read_bytes() == content
    assert records.get("0/image-1", Done) is None
    assert records.get("0/image-2", Done) == Done(pixels=2)
    assert records.set_damaged_aside({"image": Done}) == []


def test_an_attempt_that_was_overtaken_writes_no_record(tmp_path: Path) -> None:
    older = RecordFiles(tmp_path / "work", StageWriter(tmp_path, "prepared", 1).require_lease)
    StageWriter(tmp_path, "prepared", 2)
    with pytest.raises(FencedError):
        older.put("0/image-1", Done(pixels=3))
    assert not (tmp_path / "work").exists()
