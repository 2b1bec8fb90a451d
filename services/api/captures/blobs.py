"""Contents by their SHA-256 below one folder, and files on their way to become such.

::

    blobs/ab/cdef…               a verified content, for its owner alone and read-only
    partial/<capture>/<number>   what has been received of one file
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from services.core.errors import DiskFullError

Write = Callable[[int, memoryview], int]
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class PartialFile:
    """The end of a file that is being received; whatever lies beyond ``offset`` is cut off first."""

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
            raise _disk_full(problem) from problem

    def sync(self) -> None:
        """Return once everything written would survive a power cut."""
        try:
            os.fsync(self._descriptor)
        except OSError as problem:
            raise _disk_full(problem) from problem


class Blobs:
    """The contents that a server holds."""

    def __init__(self, data: Path, write: Write = os.write) -> None:
        self._blobs, self._partial, self._write = data / "blobs", data / "partial", write

    def path(self, sha256: str) -> Path:
        """Where a content lies, or would."""
        return self._blobs / sha256[:2] / sha256[2:]

    def holds(self, sha256: str, size_bytes: int) -> bool:
        """Whether the content is here."""
        try:
            return self.path(sha256).stat().st_size == size_bytes
        except FileNotFoundError:
            return False

    def received_bytes(self, capture: str, number: int) -> int:
        """How much of a partial file is on disk, recorded or not."""
        try:
            return self._partial_path(capture, number).stat().st_size
        except FileNotFoundError:
            return 0

    def open_partial(self, capture: str, number: int, offset: int) -> PartialFile:
        """Go on with a file after its first ``offset`` bytes."""
        return PartialFile(self._partial_path(capture, number), offset, self._write)

    def adopt(self, capture: str, number: int, sha256: str) -> bool:
        """Make a received file a content if it has this SHA-256, else discard it; returns which.

        It stays a partial file too, to be discarded once its content is recorded as known: a server that dies before
        that finds it whole.
        """
        partial, final = self._partial_path(capture, number), self.path(sha256)
        with partial.open("rb") as stream:
            is_right = hashlib.file_digest(stream, "sha256").hexdigest() == sha256
        if not is_right:
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
        """Forget what was received of one file, or of all files of a capture."""
        if number is None:
            shutil.rmtree(self._partial / capture, ignore_errors=True)
        else:
            self._partial_path(capture, number).unlink(missing_ok=True)

    def remove(self, sha256: str) -> None:
        """Forget a content."""
        self.path(sha256).unlink(missing_ok=True)

    def _partial_path(self, capture: str, number: int) -> Path:
        return self._partial / capture / str(number)


def sync_folders(*folders: Path) -> None:
    """Make names in these folders survive a power cut."""
    for folder in folders:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _disk_full(problem: OSError) -> Exception:
    if problem.errno in _FULL:
        return DiskFullError(
            "The server's disk is full; free some space there and send again, what was acknowledged is kept."
        )
    return problem
