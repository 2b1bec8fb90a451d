"""Files of a job that may be read from outside, and only those."""

from __future__ import annotations

import mimetypes
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pydantic import Field

from services.api.problems import refusals, response_of
from services.core.errors import RangeError, UnknownJobError
from services.core.geometry import Record
from services.core.stage import CANCEL_FLAG

if TYPE_CHECKING:
    from fastapi import Request, Response

_INTERNAL_SUFFIXES = (".lease", ".partial", ".sqlite", ".sqlite-wal", ".sqlite-shm")
_STORES = (".zarr",)
_RANGE = re.compile(r"(?=.*[0-9])(?P<first>[0-9]{0,30})-(?P<last>[0-9]{0,30})")

ANSWERS = refusals(416) | {
    200: {"content": {"*/*": {}}},
    206: {"description": "The bytes that Range names", "content": {"*/*": {}}},
    304: {"description": "The file is the one that If-None-Match names"},
}
"""What the description says of routes that answer with a file."""

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
    with suppress(OSError):  # a path too long for the disk
        if inside and _is_public(relative) and path.resolve().is_relative_to(root.resolve()) and path.is_file():
            return path
    raise UnknownJobError(f"The job has no artifact {name!r}; list its artifacts to see their paths.")


def artifact_response(request: Request, path: Path) -> Response:
    """The file with an ETag; answers conditional and range requests. A Range header that cannot be read is ignored (RFC 9110, 14.2)."""
    from fastapi.responses import FileResponse, Response

    stat = path.stat()
    tag = f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'
    headers = {"ETag": tag}
    if path.suffix == ".html":
        headers["Content-Security-Policy"] = REPORT_POLICY
    if tag in (request.headers.get("if-none-match") or ""):
        return Response(status_code=304, headers=headers)
    response = FileResponse(path, headers=headers, media_type=_media_type(path), stat_result=stat)
    asked = request.headers.get("range")
    if asked is not None and request.headers.get("if-range", tag) in {tag, response.headers["last-modified"]}:
        starts = _first_bytes(asked, stat.st_size)
        if starts is None:
            request.scope["headers"] = [header for header in request.scope["headers"] if header[0] != b"range"]
        elif max(starts) >= stat.st_size:
            problem = RangeError(f"The file has {stat.st_size} bytes, not those that '{asked}' names; ask for others.")
            return response_of(problem, request.scope["path"], {"Content-Range": f"bytes */{stat.st_size}"})
    return response


def _first_bytes(asked: str, size_bytes: int) -> list[int] | None:
    """Where each range that a Range header names begins; None if it is malformed or counts in another unit (RFC 9110, 14.1)."""
    unit, _, ranges = asked.partition("=")
    found = [_RANGE.fullmatch(part.strip()) for part in ranges.split(",")]
    parts = [(part["first"], part["last"]) for part in found if part is not None]
    if unit.strip().lower() != "bytes" or len(parts) < len(found) or any(first and last and int(last) < int(first) for first, last in parts):
        return None
    return [int(first) if first else max(0, size_bytes - int(last)) for first, last in parts]


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
