"""A disk of a test's own that can be full, read-only or frozen. Only the superuser mounts it."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

REST_BYTES, BLOCK_BYTES = 2**25, 4096
"""What is filled block by block, as the file system takes some of its own."""


class StoreDisk:
    """A file system in a file, mounted on a folder; next to nothing of its size is stored."""

    def __init__(self, folder: Path, size_bytes: int) -> None:
        self.folder, self._image, self._size_bytes = folder, folder.with_suffix(".image"), size_bytes

    def open(self) -> None:
        """Make and mount it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._image.open("wb") as image:
            image.truncate(self._size_bytes)
        _run("mkfs.ext4", "-q", "-F", "-m", "0", str(self._image))
        _run("mount", "-o", "loop", str(self._image), str(self.folder))

    def close(self) -> None:
        """Unmount and remove it."""
        _run("umount", "--lazy", str(self.folder), check=False)
        self._image.unlink(missing_ok=True)

    @contextmanager
    def full(self) -> Iterator[None]:
        """Without a free block for the time of the block."""
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
        """With so much free for the time of the block."""
        filling = self.folder / "filling"
        _run("fallocate", "--length", str(shutil.disk_usage(self.folder).free - free_bytes), str(filling))
        try:
            yield
        finally:
            filling.unlink()

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Every write, and everything that would kill a writer, waits for the end of the block."""
        _run("fsfreeze", "--freeze", str(self.folder))
        try:
            yield
        finally:
            _run("fsfreeze", "--unfreeze", str(self.folder))


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder that takes no write for the time of the block, by whatever is not open yet."""
    _run("mount", "--bind", str(folder), str(folder))
    try:
        _run("mount", "-o", "remount,bind,ro", str(folder))
        yield
    finally:
        _run("umount", "--lazy", str(folder))


@contextmanager
def store_disk(folder: Path, size_bytes: int = 24 * 2**30) -> Iterator[StoreDisk]:
    """A disk on a folder for the time of the block. Skips where nothing can be mounted."""
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
