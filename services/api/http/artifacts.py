"""Lists and serves the files of a job that clients may read, and no others."""

from __future__ import annotations

import mimetypes
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from email.utils import formatdate
from pathlib import Path, PurePath, PurePosixPath
from typing import TYPE_CHECKING

from pydantic import Field

from services.api.http.problems import refusals, response_of
from services.client.errors import RangeError, UnknownJobError
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
"""OpenAPI responses of the routes that answer with a file."""

MAX_BYTES_AT_ONCE = 2**20
"""Largest file or range, in bytes, that is read at once in the thread of the handler. Longer ones are read block by
block, each with a switch to another thread."""

REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:;"
    " frame-ancestors 'none'"
)
"""Content-Security-Policy of HTML reports and SVG drawings. They contain all that they need, so they may load nothing,
not even from this server, and no page may embed them."""


class Artifact(Record):
    """A file that a job made."""

    path: str = Field(description="relative to the job's artifacts")
    bytes: int
    media_type: str


def list_artifacts(root: Path) -> list[Artifact]:
    """List every readable file below a job's folder, sorted by path. Arrays inside Zarr stores are left out."""
    found = sorted(_walk(root)) if root.is_dir() else []
    return [Artifact(path=str(path), bytes=size_bytes, media_type=_media_type(path)) for path, size_bytes in found]


def open_artifact(root: Path, name: str) -> Path:
    """Return the file behind an artifact's path. As in the list, a symbolic link and anything behind one is not an
    artifact.

    Raises:
        UnknownJobError: the path names no readable file of this job.
    """
    relative = PurePosixPath(name)
    path = root.joinpath(*relative.parts)
    inside = not relative.is_absolute() and ".." not in relative.parts and "\0" not in name
    with suppress(OSError):  # a path too long for the disk
        if (
            inside
            and _is_public(relative)
            and not any((root / part).is_symlink() for part in (relative, *relative.parents[:-1]))
            and path.is_file()
        ):
            return path
    raise UnknownJobError(f"The job has no artifact {name!r}; list its artifacts to see their paths.")


def artifact_response(request: Request, path: Path) -> Response:
    """Answer with the file and its ETag; conditional and range requests are supported.

    A Range header that cannot be read is ignored (RFC 9110, 14.2).
    """
    from fastapi.responses import FileResponse, Response

    stat = path.stat()
    tag, modified = f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"', formatdate(stat.st_mtime, usegmt=True)
    headers = {"ETag": tag, "Last-Modified": modified, "Accept-Ranges": "bytes"}
    if path.suffix in {".html", ".svg"}:
        headers["Content-Security-Policy"] = REPORT_POLICY
    if tag in (request.headers.get("if-none-match") or ""):
        return Response(status_code=304, headers=headers)
    range_header = request.headers.get("range")
    if range_header is not None and request.headers.get("if-range", tag) not in {tag, modified}:
        range_header = None
    ranges = None if range_header is None else _ranges(range_header, stat.st_size)
    if ranges is not None and max(ranges)[0] >= stat.st_size:
        problem = RangeError(
            f"The file has {stat.st_size} bytes, not those that '{range_header}' names; ask for others."
        )
        return response_of(problem, request.scope["path"], {"Content-Range": f"bytes */{stat.st_size}"})
    first, end = (0, stat.st_size) if ranges is None else ranges[0]
    if (ranges is None or len(ranges) == 1) and end - first <= MAX_BYTES_AT_ONCE:
        if ranges is not None:
            headers["Content-Range"] = f"bytes {first}-{end - 1}/{stat.st_size}"
        return Response(_read(path, first, end), 200 if ranges is None else 206, headers, _media_type(path))
    if ranges is None:
        request.scope["headers"] = [header for header in request.scope["headers"] if header[0] != b"range"]
    return FileResponse(path, headers=headers, media_type=_media_type(path), stat_result=stat)


def _ranges(range_header: str, size_bytes: int) -> list[tuple[int, int]] | None:
    """Parse a Range header into pairs of the first byte and the byte after the last one. Returns None if the header is
    malformed or counts in another unit than bytes (RFC 9110, 14.1).
    """
    unit, _, ranges = range_header.partition("=")
    found = [_RANGE.fullmatch(part.strip()) for part in ranges.split(",")]
    parts = [(part["first"], part["last"]) for part in found if part is not None]
    if (
        unit.strip().lower() != "bytes"
        or len(parts) < len(found)
        or any(first and last and int(last) < int(first) for first, last in parts)
    ):
        return None
    return [_limits(first, last, size_bytes) for first, last in parts]


def _limits(first: str, last: str, size_bytes: int) -> tuple[int, int]:
    if not first:
        return max(0, size_bytes - int(last)), size_bytes  # a suffix range: the last bytes of the file
    return int(first), min(int(last) + 1, size_bytes) if last else size_bytes


def _read(path: Path, first: int, end: int) -> bytes:
    with path.open("rb") as stream:
        stream.seek(first)
        return stream.read(end - first)


def _walk(folder: Path, below: PurePosixPath = PurePosixPath()) -> Iterator[tuple[PurePosixPath, int]]:  # noqa: B008 - immutable
    """Yield the paths of readable files, relative to the job's folder, and their sizes in bytes."""
    with os.scandir(folder) as entries:
        for entry in entries:
            relative = below / entry.name
            if entry.is_symlink() or not _is_public(relative):
                continue
            if not entry.is_dir():
                yield relative, entry.stat().st_size
            elif relative.suffix not in _STORES:
                yield from _walk(folder / entry.name, relative)


def _is_public(relative: PurePosixPath) -> bool:
    hidden = any(part.startswith(".") for part in relative.parts)
    return (
        bool(relative.parts)
        and not hidden
        and not relative.name.endswith(_INTERNAL_SUFFIXES)
        and relative.parts != (CANCEL_FLAG,)
    )


def _media_type(path: PurePath) -> str:
    return mimetypes.guess_type(path.name)[0] or "application/octet-stream"
