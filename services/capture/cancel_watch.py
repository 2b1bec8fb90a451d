"""Check for a cancel while a light is on, so that the light does not stay on until the exposure is over."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

CHECK_INTERVAL_S = 0.05
"""Interval between checks in seconds: a tenth of the half second within which a cancel must have darkened the dome. A
check costs one request to the file system."""


@contextmanager
def interrupt_on_cancel(
    raise_if_cancelled: Callable[[], None], interrupt: Callable[[Exception], None]
) -> Iterator[None]:
    """Check repeatedly for a cancel during the block, in a separate thread.

    Args:
        raise_if_cancelled: raises if the work is cancelled, or if that cannot be determined.
        interrupt: called once with the exception that was raised.
    """
    is_over = threading.Event()

    def watch() -> None:
        while not is_over.wait(CHECK_INTERVAL_S):
            try:
                raise_if_cancelled()
            except Exception as problem:
                interrupt(problem)
                return

    # Use a daemon thread with a short join, because a disk that hangs may block it for ever and must block nothing
    # else.
    thread = threading.Thread(target=watch, name="capture cancel watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join(10 * CHECK_INTERVAL_S)
