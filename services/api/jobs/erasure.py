"""Removes a job's folder completely, and records what was removed, for the receipt."""

from __future__ import annotations

import hashlib
import json
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from services.core.errors import StoreError
from services.core.files.object_store import discard_remote
from services.core.store import sha256_of, write_atomic


@dataclass(frozen=True)
class Erased:
    """Number, size and digest of the files that were removed."""

    files: int
    bytes: int
    digest: str
    """SHA-256 over lines of path, size and SHA-256 of every file, sorted by path."""


def erase(folder: Path) -> Erased:
    """Remove a job's folder, everything below it and what its stages keep on S3 servers; an absent folder counts as
    empty.

    A removal that was interrupted is continued, and its result counts the files that were there at its beginning.

    Raises:
        StoreError: a file could not be read or removed, or the record of the removed files could not be written.
        PlatformError: the package that speaks to S3 servers is not installed.
    """
    listing = _listing(folder)
    try:
        if not listing.exists():
            listing.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(listing, json.dumps(asdict(_measure(folder))).encode())
        discard_remote(folder, "*/*.zarr")
        while folder.exists():
            with suppress(FileNotFoundError):  # removed by another process meanwhile
                shutil.rmtree(folder)
        return Erased(**json.loads(listing.read_text()))
    except OSError as problem:
        what = f"{problem.filename or folder} could not be removed ({problem.strerror})"
        raise StoreError(f"{what}; correct its permissions or its disk and delete the job again.") from problem


def forget_listing(folder: Path) -> None:
    """Remove the record that ``erase`` wrote beside the folder, once the receipt is stored."""
    _listing(folder).unlink(missing_ok=True)


def _listing(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.erasing")


def _measure(folder: Path) -> Erased:
    lines, size = [], 0
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()):
        content, length = sha256_of(path), path.stat().st_size
        lines.append(f"{path.relative_to(folder).as_posix()} {length} {content}\n")
        size += length
    return Erased(len(lines), size, hashlib.sha256("".join(lines).encode()).hexdigest())
