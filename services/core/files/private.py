"""Files that only their owner may read: keys, passwords."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

PRIVATE = 0o077
"""File mode creation mask (umask) of every process of the service: only its own user may access its files."""


def write_private(path: Path, content: bytes, mode: int = 0o600) -> None:
    """Write a file atomically: a reader sees the old or the new content, and only users that ``mode`` admits see it."""
    fresh = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        os.fchmod(stream.fileno(), mode)
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    fresh.replace(path)
