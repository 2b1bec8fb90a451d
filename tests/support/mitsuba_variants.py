"""Another variant of Mitsuba within a test, which leaves the process as it was: the engine refuses any but its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from services.transport.platform import prepare_device


@contextmanager
def variant(name: str) -> Iterator[None]:
    """Use another variant of Mitsuba for the time of the block."""
    prepare_device()
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant(name)
    try:
        yield
    finally:
        mi.set_variant(before)
