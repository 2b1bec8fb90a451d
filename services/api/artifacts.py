"""Files of a job that may be read from outside, and only those."""

from __future__ import annotations

import mimetypes
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pydantic import Field

from services.core.errors import UnknownJobError
from services.core.geometry import Record
from services.core.stage import CANCEL_FLAG

if TYPE_CHECKING:
    from fastapi import Request, Response

_INTERNAL_SUFFIXES = (".lease", ".partial", ".sqlite", ".sqlite-wal", ".sqlite-shm")
_STORES = (".zarr",)

REPORT_POLICY = "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
"""A report opens alone and carries all it needs; it may reach nothing, this server included."""


class Artifact(Record):
    """A file that a job made."""

    path: str = Field(description="relative to the job's artifacts")
    bytes: int
    media_type: str


def list_artifacts(root: Path) -> list[Artifact]:
    """Every readable file below a job's folder, sorted by path; arrays inside stores are left out."""
    found = sorted(_walk(root))
    return [Artifact(path=path.relative_to(root).as_posix(), bytes=path.stat().st_size, media_type=_media_type(path)) for path in found]


def open_artifact(root: Path, name: str) -> Path:
    """The file behind an artifact's path.

    Raises:
        UnknownJobError: not a readable file of this job, whatever the path tries.
    """
    relative = PurePosixPath(name)
    path = root.joinpath(*relative.parts)
    inside = not relative.is_absolute() and ".." not in relative.parts and "\0" not in name
    if not inside or not _is_public(relative) or not path.resolve().is_relative_to(root.resolve()) or not path.is_file():
        raise UnknownJobError(f"The job has no artifact {name!r}; list its artifacts to see their paths.")
    return path


def artifact_response(request: Request, path: Path) -> Response:
    """The file with an ETag; answers conditional and range requests."""
    from fastapi.responses import FileResponse, Response

    stat = path.stat()
    tag = f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'
    headers = {"ETag": tag}
    if path.suffix == ".html":
        headers["Content-Security-Policy"] = REPORT_POLICY
    if tag in (request.headers.get("if-none-match") or ""):
        return Response(status_code=304, headers=headers)
    return FileResponse(path, headers=headers, media_type=_media_type(path), stat_result=stat)


def _walk(folder: Path, below: PurePosixPath = PurePosixPath()) -> Iterator[Path]:  # noqa: B008 - immutable
    for path in folder.iterdir() if folder.is_dir() else ():
        relative = below / path.name
        if path.is_symlink() or not _is_public(relative):
            continue
        if path.is_dir():
            if path.suffix not in _STORES:
                yield from _walk(path, relative)
        else:
            yield path


def _is_public(relative: PurePosixPath) -> bool:
    hidden = any(part.startswith(".") for part in relative.parts)
    return bool(relative.parts) and not hidden and not relative.name.endswith(_INTERNAL_SUFFIXES) and relative.parts != (CANCEL_FLAG,)


def _media_type(path: Path) -> str:
    return mimetypes.guess_type(path.name)[0] or "application/octet-stream"
