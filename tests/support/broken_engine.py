"""An engine whose calls fail in the ways in which a process can fail."""

from __future__ import annotations

import os
import time
from typing import Any


class PickyError(Exception):
    """An exception with a keyword-only argument, as some libraries have them: it does not survive pickling."""

    def __init__(self, *, code: int) -> None:
        super().__init__(f"refused with code {code}")


class BrokenEngine:
    """Stand-in for the real engine; it builds no scene."""

    def __init__(self, recipe: Any, threads: int | None = None) -> None:  # noqa: ARG002 - signature of what is replaced
        self.kept: list[bytes] = []

    def answer(self, value: int) -> int:
        """Return the value; this call does not fail."""
        return value

    def grow(self, step_bytes: int) -> None:
        """Allocate more and more memory and write to it, so that it becomes resident."""
        while True:
            self.kept.append(os.urandom(1) * step_bytes)
            time.sleep(0.01)

    def hang(self, started: str) -> None:
        """Sleep like a kernel that does not end, after writing the process id to the file ``started``."""
        with open(started, "w") as stream:  # noqa: PTH123 - plain, in a process that is about to be killed
            stream.write(str(os.getpid()))
        time.sleep(3600)

    def refuse(self) -> None:
        """Raise an exception that cannot be unpickled at the other end of a pipe."""
        raise PickyError(code=7)

    def die(self, number: int) -> None:
        """End this process by a signal."""
        os.kill(os.getpid(), number)
        time.sleep(3600)
