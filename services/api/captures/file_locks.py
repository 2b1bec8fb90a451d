"""Locks on the files of captures. They hold within this process, which is the only server of its data folder."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from services.client.errors import LockedError


class FileLocks:
    """The files of captures that some request is working on."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: set[tuple[str, int]] = set()

    @contextmanager
    def hold(self, capture: str, number: int) -> Iterator[None]:
        """Hold the lock of a file.

        Raises:
            LockedError: another request holds it.
        """
        with self._lock:
            if (capture, number) in self._held:
                raise LockedError(
                    f"Another request is sending file number {number} of capture {capture}; wait for it to end."
                )
            self._held.add((capture, number))
        try:
            yield
        finally:
            with self._lock:
                self._held.discard((capture, number))

    def holds_any(self, capture: str) -> bool:
        """Whether some request is working on a file of this capture."""
        with self._lock:
            return any(held == capture for held, _ in self._held)
