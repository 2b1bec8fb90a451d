"""Durable execution: results of a fit or a slab are recorded, and a new attempt reads them instead of computing them
again.

The driver is a deterministic function. Each costly part runs as ``journal.get_or_compute(key, compute)``; its JSON
result is on disk before the next part starts. A later attempt runs the same function, gets the recorded results back in
the same order, and continues where the record ends. Every part depends only on recorded results and on seeds, so an
interrupted fit has the same result as an uninterrupted one.

::

    {"format": 2, "fingerprint": "..."}     first line
    {"key": "...", "value": ...}            one line a result, appended; a last line that was cut short is no result
    {"key": "...", "value": ..., "arrays": {"file": "...", "digest": "..."}}
    {"key": "...", "forgotten": true}

Of several lines with one key the last counts. Arrays lie beside the journal in a file that is named by its content. It
is whole before the line that names it is written, and the file before it goes afterwards, so a crash leaves either.

An attempt that adds to a journal first replaces the file by a copy under the same name, once, so that an older attempt
that still runs cannot write into it. Format 1, one JSON object that was rewritten with every result, is read and
continued as format 2.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CorruptStoreError, FencedError
from services.core.files.content_files import StoredFile, write_arrays
from services.core.store import write_atomic

FORMAT_VERSION = 2
"""Version of the format that is written."""


class Journal:
    """Results by key, in one file that grows by a line with every result.

    Attributes:
        resumed: number of results that an earlier attempt left.
        set_aside: path to which a checkpoint of another fit was moved, kept for its owner; None where there was none.
        notes: sentences on what cannot be continued.
    """

    def __init__(self, path: Path, fingerprint: str, guard: Callable[[], None] = lambda: None) -> None:
        """Open the journal at ``path``, or begin one.

        Args:
            path: the journal's file; a file of format 1 beside it, with the suffix ``.json``, is continued.
            fingerprint: identifies job, data and numerics; a journal with another fingerprint is kept under another
                name and not continued.
            guard: called before every write; raises when this attempt has lost the right to write.
        """
        self.path, self._fingerprint, self._guard = path, fingerprint, guard
        self._earlier = path if path.is_file() else path.with_suffix(".json")
        self._inode: int | None = None
        self.entries: dict[str, Any] = {}
        self._files: dict[str, StoredFile] = {}
        self.set_aside: Path | None = None
        self.notes: list[str] = []
        if self._earlier.is_file():
            owner, entries, files = _read(self._earlier)
            if owner == fingerprint:
                self.entries, self._files = entries, files
                self._forget_damaged()
            else:
                guard()
                self.set_aside = _free_name(self._earlier)
                self._earlier.rename(self.set_aside)
                self.notes.append(
                    "The checkpoint is damaged or of another job, data or numerics: it is kept as"
                    f" {self.set_aside.name} and this fit starts anew."
                )
        self.resumed = len(self.entries)

    def get_or_compute(self, key: str, compute: Callable[[], Any]) -> tuple[Any, bool]:
        """The recorded result of ``key``; without a record, compute and record it. The flag says whether it is new.

        Floats survive exactly.
        """
        if key in self.entries:
            return self.entries[key], False
        value = json.loads(json.dumps(compute(), allow_nan=False))
        self._write({"key": key, "value": value})
        self.entries[key] = value
        return value, True

    def put(self, key: str, value: Any, **arrays: NDArray[Any]) -> None:
        """Record a result in place of the one that the key had, with arrays that are too large for a line; their
        file's name begins with the key.
        """
        value = json.loads(json.dumps(value, allow_nan=False))
        self._guard()
        file = write_arrays(self.path.parent, key, **arrays)
        self._write(_result(key, value, file))
        self._drop_file(key, keep=file)
        self.entries[key], self._files[key] = value, file

    def arrays(self, key: str) -> dict[str, NDArray[np.generic]]:
        """Arrays that were recorded with a key."""
        return self._files[key].load()

    def forget(self, key: str) -> None:
        """Remove a result that is not needed any more, if there is one."""
        if self.entries.pop(key, None) is not None:
            self._write({"key": key, "forgotten": True})
            self._drop_file(key)

    def _drop_file(self, key: str, keep: StoredFile | None = None) -> None:
        """Remove the arrays that a key had, unless its new result has the same."""
        earlier = self._files.pop(key, None)
        if earlier is not None and earlier != keep:
            earlier.path.unlink(missing_ok=True)

    def _forget_damaged(self) -> None:
        """Leave out results whose arrays are missing or altered, and set altered ones aside."""
        for key, file in list(self._files.items()):
            try:
                file.load()
            except CorruptStoreError:
                self._guard()
                del self._files[key], self.entries[key]
                if file.path.is_file():  # else the same arrays could not be written again
                    file.path.rename(_free_name(file.path))
                self.notes.append(f"{file.path.name} is missing or altered; what it held is computed again.")

    def _write(self, line: dict[str, Any]) -> None:
        self._guard()
        if self._inode is None:
            self._begin()
        try:
            self._append(_line(line))
        except BaseException:
            # Discard a partly written line with its file: the next result begins a new file.
            self._inode = None
            raise

    def _begin(self) -> None:
        """Write the recorded results into a new file of this attempt."""
        lines = [
            {"format": FORMAT_VERSION, "fingerprint": self._fingerprint},
            *(_result(key, value, self._files.get(key)) for key, value in self.entries.items()),
        ]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(self.path, b"".join(map(_line, lines)))
        self._inode = self.path.stat().st_ino
        if self._earlier != self.path:
            self._earlier.unlink(missing_ok=True)

    def _append(self, line: bytes) -> None:
        with self.path.open("ab", buffering=0) as stream:
            if os.fstat(stream.fileno()).st_ino != self._inode:
                raise FencedError(f"{self.path} was taken over by another attempt; the writes of this one are refused.")
            if stream.write(line) != len(line):
                raise OSError(f"{self.path} took only a part of a line")
            os.fsync(stream.fileno())


def read_entries(path: Path) -> dict[str, Any]:
    """Results in a journal, whatever its fingerprint; empty where the file is damaged."""
    return _read(path)[1] if path.is_file() else {}


def read_arrays(path: Path, key: str) -> dict[str, NDArray[np.generic]]:
    """Arrays that a journal, whatever its fingerprint, has of a key.

    Raises:
        CorruptStoreError: their file is missing or altered.
    """
    return _read(path)[2][key].load()


def _read(path: Path) -> tuple[str | None, dict[str, Any], dict[str, StoredFile]]:
    """Fingerprint, results and files of arrays of a file; None and empty where it is no journal."""
    head, *lines = path.read_bytes().split(b"\n")
    try:
        first = json.loads(head)
        match first:
            case {"format": 1, "fingerprint": str(owner), "entries": dict(entries)} if not any(lines):
                return owner, entries, {}
            case {"format": 2, "fingerprint": str(owner)} if lines:
                # Ignore the text after the last line break: a line that was cut short.
                results = [json.loads(line) for line in lines[:-1]]
                last = {result["key"]: result for result in results}
                kept = {key: result for key, result in last.items() if "forgotten" not in result}
                values = {key: result["value"] for key, result in kept.items()}
                return (
                    owner,
                    values,
                    {
                        key: StoredFile(path.parent / result["arrays"]["file"], result["arrays"]["digest"])
                        for key, result in kept.items()
                        if "arrays" in result
                    },
                )
    except (ValueError, KeyError, TypeError):
        pass
    return None, {}, {}


def _result(key: str, value: Any, file: StoredFile | None) -> dict[str, Any]:
    """A result as a line records it."""
    arrays = {} if file is None else {"arrays": {"file": file.path.name, "digest": file.digest}}
    return {"key": key, "value": value, **arrays}


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value).encode() + b"\n"


def _free_name(path: Path) -> Path:
    numbers = (path.with_stem(f"{path.stem}-set-aside-{k}") for k in itertools.count(1))
    return next(candidate for candidate in numbers if not candidate.exists())
