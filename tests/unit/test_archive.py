"""The streamed zip file is correct: checked with the standard library's reader and with ``unzip``, beyond the limit
where zip64 begins, and for memory.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from services.api.http.zip_stream import PIECE_BYTES, stream_zip


def write(root: Path, **files: bytes) -> list[str]:
    for name, content in files.items():
        (root / name).write_bytes(content)
    return sorted(files)


def test_a_zip_holds_every_file_stored(tmp_path: Path) -> None:
    names = write(tmp_path, empty=b"", small=b"abc", large=os.urandom(3 * PIECE_BYTES + 7))
    (tmp_path / "below").mkdir()
    names += write(tmp_path / "below", **{"Zähne.txt": b"x" * 1000})
    names[-1] = "below/Zähne.txt"
    target = tmp_path / "all.zip"
    target.write_bytes(b"".join(stream_zip(tmp_path, names)))
    with zipfile.ZipFile(target) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == names
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
        assert all(archive.read(name) == (tmp_path / name).read_bytes() for name in names)
    if shutil.which("unzip"):
        subprocess.run(["unzip", "-tq", target], check=True, capture_output=True)


def test_no_files_make_an_empty_zip(tmp_path: Path) -> None:
    target = tmp_path / "none.zip"
    target.write_bytes(b"".join(stream_zip(tmp_path, [])))
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == []


def test_large_files_and_offsets_are_zip64(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The writer's limit is lowered, so that the reader needs the zip64 records."""
    names = write(tmp_path, a=os.urandom(5000), b=os.urandom(100))
    target = tmp_path / "all.zip"
    with monkeypatch.context() as lowered:
        lowered.setattr(zipfile, "ZIP64_LIMIT", 1000)
        target.write_bytes(b"".join(stream_zip(tmp_path, names)))
    with zipfile.ZipFile(target) as archive:
        assert [info.extract_version for info in archive.infolist()] == [45, 45]
        assert all(archive.read(name) == (tmp_path / name).read_bytes() for name in names)


def test_files_that_change_meanwhile_do_not_break_the_zip(tmp_path: Path) -> None:
    names = write(tmp_path, gone=b"x", grows=b"y" * (2 * PIECE_BYTES), last=b"z")
    pieces = stream_zip(tmp_path, names)
    (tmp_path / "gone").unlink()
    content = next(pieces)
    with (tmp_path / "grows").open("ab") as stream:
        stream.write(b"more")
    target = tmp_path / "all.zip"
    target.write_bytes(content + b"".join(pieces))
    with zipfile.ZipFile(target) as archive:
        assert archive.testzip() is None
        assert {info.filename: info.file_size for info in archive.infolist()} == {"grows": 2 * PIECE_BYTES, "last": 1}


def test_memory_does_not_grow_with_the_files(tmp_path: Path) -> None:
    with (tmp_path / "sparse").open("wb") as stream:
        stream.truncate(64 * 2**20)
    tracemalloc.start()
    try:
        sent = sum(len(piece) for piece in stream_zip(tmp_path, ["sparse"]))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert sent > 64 * 2**20
    assert peak < 2**22
