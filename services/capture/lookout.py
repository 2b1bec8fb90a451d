"""Looks for a cancel while a light is on, so that the light does not last until the exposure is over."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LOOK_EVERY_S = 0.05
"""A tenth of the half second within which a cancel must have darkened the dome; a look costs one question to the file
system."""


@contextmanager
def interrupting(raise_if_cancelled: Callable[[], None], interrupt: Callable[[Exception], None]) -> Iterator[None]:
    """Ask again and again during the block whether to go on, from a thread of its own.

    Args:
        raise_if_cancelled: raises once the work is not wanted any more, or once that cannot be found out.
        interrupt: told what was raised, once.
    """
    is_over = threading.Event()

    def look() -> None:
        while not is_over.wait(LOOK_EVERY_S):
            try:
                raise_if_cancelled()
            except Exception as why:
                interrupt(why)
                return

    # A daemon, not joined for long: a disk that hangs may hold it for ever, and must hold nothing else.
    thread = threading.Thread(target=look, name="capture lookout", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join(10 * LOOK_EVERY_S)
