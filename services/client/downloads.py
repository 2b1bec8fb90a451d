"""Downloads of both clients: a file appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from services.core.errors import InputError, PlatformError


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file that appears under its name once the block has ended without an error.

    Raises:
        InputError: the file exists already, or cannot be written.
    """
    if path.exists():
        raise InputError(f"{path} exists already; remove it or give another name with --out.")
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as stream:
            yield stream
        partial.rename(path)
    except OSError as problem:
        raise InputError(f"{path} cannot be written ({problem.strerror}); give another place with --out.") from problem
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def translated_transport_errors(server: str) -> Iterator[None]:
    """Replace the error of a broken connection by one sentence.

    Raises:
        PlatformError: the connection broke.
    """
    import httpx

    try:
        yield
    except httpx.HTTPError as problem:
        raise PlatformError(f"The download from {server} broke off ({problem}); repeat the command.") from problem
