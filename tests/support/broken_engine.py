"""An engine whose calls go wrong in the ways that a process can."""

from __future__ import annotations

import os
import time
from typing import Any


class PickyError(Exception):
    """An exception as libraries have them: made from more than its arguments."""

    def __init__(self, *, code: int) -> None:
        super().__init__(f"refused with code {code}")


class BrokenEngine:
    """Takes the place of the real one; builds nothing."""

    def __init__(self, recipe: Any, threads: int | None = None) -> None:  # noqa: ARG002 - signature of what is replaced
        self.kept: list[bytes] = []

    def answer(self, value: int) -> int:
        """Nothing goes wrong."""
        return value

    def grow(self, step_bytes: int) -> None:
        """Take more and more memory, and really use it."""
        while True:
            self.kept.append(os.urandom(1) * step_bytes)
            time.sleep(0.01)

    def hang(self, started: str) -> None:
        """A kernel that does not end; the file says that it runs."""
        with open(started, "w") as stream:  # noqa: PTH123 - plain, in a process that is about to be killed
            stream.write(str(os.getpid()))
        time.sleep(3600)

    def refuse(self) -> None:
        """Raise what does not come out whole at the other end of a pipe."""
        raise PickyError(code=7)

    def die(self, number: int) -> None:
        """End by a signal."""
        os.kill(os.getpid(), number)
        time.sleep(3600)
