"""Lists of hashes beside exported files, in the form of a published stage's manifest."""

from __future__ import annotations

import json
from pathlib import Path

from services.core.errors import CorruptStoreError, MissingStageError
from services.core.store import FORMAT_VERSION, MANIFEST, sha256_of, write_atomic


def write_hash_list(folder: Path, name: str) -> None:
    """List size and SHA-256 of all files below a folder in its ``manifest.json``."""
    files = {
        path.relative_to(folder).as_posix(): {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
        for path in _files(folder)
    }
    manifest = {"format": FORMAT_VERSION, "stage": name, "files": files}
    write_atomic(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())


def require_unedited(folder: Path) -> tuple[str, ...]:
    """Compare the files of a folder with its list; return the names of files that are not listed.

    The list tells of accidents and of edits by hand. It is no signature: who edits the list too is not noticed.

    Raises:
        MissingStageError: there is no list. CorruptStoreError: a file was edited or removed, or the list cannot be
            read.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise MissingStageError(
            f"{folder} holds no {MANIFEST}, so nothing says whether it was edited; write it again with dentine export."
        )
    try:
        listed = {str(name): str(one["sha256"]) for name, one in json.loads(path.read_bytes())["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        raise CorruptStoreError(f"{path} cannot be read; write the asset again with dentine export.") from problem
    for name, sha256 in listed.items():
        if not (folder / name).is_file():
            raise CorruptStoreError(
                f"{folder / name} was removed since the asset was written; restore it, or write the asset again with"
                " dentine export."
            )
        if sha256_of(folder / name) != sha256:
            raise CorruptStoreError(
                f"{folder / name} was edited since the asset was written; restore it, or write the asset again with"
                " dentine export."
            )
    return tuple(name for name in (p.relative_to(folder).as_posix() for p in _files(folder)) if name not in listed)


def _files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / MANIFEST]
