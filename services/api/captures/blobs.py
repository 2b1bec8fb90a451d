"""Stores the contents of uploaded files by their SHA-256, and the files that are not complete yet.

::

    blobs/ab/cdef…               a verified content, for its owner alone and read-only
    partial/<capture>/<number>   the bytes of one file that are received so far
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from services.core.errors import DiskFullError
from services.core.store import sha256_of, sync_to_disk

Write = Callable[[int, memoryview], int]
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class PartialFile:
    """A file that is being received, open to append. Bytes beyond ``offset`` are cut off first."""

    def __init__(self, path: Path, offset: int, write: Write) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._write = write
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.ftruncate(self._descriptor, offset)
            os.lseek(self._descriptor, offset, os.SEEK_SET)
        except OSError:
            os.close(self._descriptor)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._descriptor)

    def write(self, block: bytes) -> None:
        """Append a block.

        Raises:
            DiskFullError: the disk is full.
        """
        try:
            rest = memoryview(block)
            while rest:
                rest = rest[self._write(self._descriptor, rest) :]
        except OSError as problem:
            raise disk_full(problem) from problem

    def sync(self) -> None:
        """Return once all written bytes would survive a power cut."""
        try:
            os.fsync(self._descriptor)
        except OSError as problem:
            raise disk_full(problem) from problem


class Blobs:
    """The contents in the data folder of a server."""

    def __init__(self, data: Path, write: Write = os.write) -> None:
        self._blobs, self._partial, self._write = data / "blobs", data / "partial", write

    def path(self, sha256: str) -> Path:
        """Return the path of a content, whether it is there or not."""
        return self._blobs / sha256[:2] / sha256[2:]

    def holds(self, sha256: str, size_bytes: int) -> bool:
        """Whether a content of this size is stored."""
        try:
            return self.path(sha256).stat().st_size == size_bytes
        except FileNotFoundError:
            return False

    def received_bytes(self, capture: str, number: int) -> int:
        """Return how many bytes of a partial file are on the disk, recorded or not."""
        try:
            return self._partial_path(capture, number).stat().st_size
        except FileNotFoundError:
            return 0

    def open_partial(self, capture: str, number: int, offset: int) -> PartialFile:
        """Open a partial file, to append after its first ``offset`` bytes."""
        return PartialFile(self._partial_path(capture, number), offset, self._write)

    def adopt(self, capture: str, number: int, sha256: str) -> bool:
        """Store a received file as a content if it has this SHA-256, else discard it; returns whether it was stored.

        The partial file stays. The caller discards it once the content is recorded as known, so that after a crash in
        between the file is found complete.
        """
        partial, final = self._partial_path(capture, number), self.path(sha256)
        if sha256_of(partial) != sha256:
            partial.unlink()
            return False
        final.parent.mkdir(parents=True, exist_ok=True)
        if not self.holds(sha256, partial.stat().st_size):
            partial.chmod(0o400)
            final.unlink(missing_ok=True)
            final.hardlink_to(partial)
            sync_folders(final.parent, self._blobs)
        return True

    def discard_partial(self, capture: str, number: int | None = None) -> None:
        """Delete the received bytes of one file, or of all files of a capture."""
        if number is None:
            shutil.rmtree(self._partial / capture, ignore_errors=True)
        else:
            self._partial_path(capture, number).unlink(missing_ok=True)

    def remove(self, sha256: str) -> None:
        """Delete a content."""
        self.path(sha256).unlink(missing_ok=True)

    def _partial_path(self, capture: str, number: int) -> Path:
        return self._partial / capture / str(number)


def sync_folders(*folders: Path) -> None:
    """Make the names in these folders survive a power cut."""
    for folder in folders:
        sync_to_disk(folder)


def disk_full(problem: OSError) -> Exception:
    """The error to raise for one of the file system: one that says that the disk is full where that is the cause."""
    if problem.errno in _FULL:
        return DiskFullError(
            "The server's disk is full; free some space there and send again, what was acknowledged is kept."
        )
    return problem
