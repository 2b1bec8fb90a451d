"""A disk for one test that can be full, read-only or frozen. Mounting it needs root."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

REST_BYTES, BLOCK_BYTES = 2**25, 4096
"""Space that is filled block by block, because the file system uses an unknown part of it itself, and size of a
block."""


class StoreDisk:
    """A file system in a sparse file, mounted on a folder; it takes hardly any space until it is written to."""

    def __init__(self, folder: Path, size_bytes: int) -> None:
        self.folder, self._image, self._size_bytes = folder, folder.with_suffix(".image"), size_bytes

    def open(self) -> None:
        """Make and mount the file system."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._image.open("wb") as image:
            image.truncate(self._size_bytes)
        _run("mkfs.ext4", "-q", "-F", "-m", "0", str(self._image))
        _run("mount", "-o", "loop", str(self._image), str(self.folder))

    def close(self) -> None:
        """Unmount and remove the file system."""
        _run("umount", "--lazy", str(self.folder), check=False)
        self._image.unlink(missing_ok=True)

    @contextmanager
    def full(self) -> Iterator[None]:
        """Leave no free disk block for the time of the ``with`` statement."""
        rest = self.folder / "rest"
        with self.almost_full(REST_BYTES):
            with rest.open("wb", buffering=0) as stream, suppress(OSError):
                while True:
                    stream.write(bytes(BLOCK_BYTES))
            try:
                yield
            finally:
                rest.unlink()

    @contextmanager
    def almost_full(self, free_bytes: int) -> Iterator[None]:
        """Leave ``free_bytes`` free for the time of the ``with`` statement."""
        filling = self.folder / "filling"
        _run("fallocate", "--length", str(shutil.disk_usage(self.folder).free - free_bytes), str(filling))
        try:
            yield
        finally:
            filling.unlink()

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Make every write wait until the end of the ``with`` statement; a waiting writer cannot be killed either."""
        _run("fsfreeze", "--freeze", str(self.folder))
        try:
            yield
        finally:
            _run("fsfreeze", "--unfreeze", str(self.folder))


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Refuse writes below a folder for the time of the ``with`` statement, except to files that are open already."""
    _run("mount", "--bind", str(folder), str(folder))
    try:
        _run("mount", "-o", "remount,bind,ro", str(folder))
        yield
    finally:
        _run("umount", "--lazy", str(folder))


@contextmanager
def store_disk(folder: Path, size_bytes: int = 24 * 2**30) -> Iterator[StoreDisk]:
    """Mount a disk on a folder for the time of the ``with`` statement. The test is skipped where mounting fails."""
    disk = StoreDisk(folder, size_bytes)
    try:
        try:
            disk.open()
        except (OSError, subprocess.CalledProcessError) as problem:
            pytest.skip(f"No disk of its own: {problem}")
        yield disk
    finally:
        disk.close()


def _run(*command: str, check: bool = True) -> None:
    with suppress(*(() if check else (OSError,))):
        subprocess.run(command, check=check, capture_output=True)
