"""Upload a folder to a server, file by file and chunk by chunk.

The server holds all state, so any later process can continue where this one ends.
"""

from __future__ import annotations

import hashlib
import random
import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeVar

from pydantic import Field

from services.client.capture_paths import path_fault, require_paths
from services.client.capture_records import CaptureDetail, CaptureFile, ManifestFile, UploadManifest
from services.client.errors import UploadError
from services.client.flows import BlockingCall, Flow, HttpRequest, Pause, answer, error_in
from services.core.consent import SUBJECT
from services.core.errors import CaptureInputError, PlatformError
from services.core.files.image_metadata import metadata_fault
from services.core.geometry import Record

if TYPE_CHECKING:
    import httpx

R = TypeVar("R")
CHUNK_BYTES = 4 * 2**20
MIN_CHUNK_BYTES = 2**18
"""Smallest size of a chunk, bytes. A chunk is recorded whole or not at all, so the size is halved after each failure,
down to this one, and an upload advances even over a bad connection."""
PATIENCE_S = 300.0
"""Time, s, for which a step of the upload is repeated while the server does not answer."""
VERIFYING_S = 900.0
"""Longest time, s, for an answer of the server, which reads the whole file after its last chunk."""
MIN_WAIT_S, MAX_WAIT_S = 0.2, 5.0
"""Shortest and longest wait between two tries, s; each wait is twice as long as the one before."""
_TRANSIENT_STATUSES = frozenset({408, 423, 429, 460, 502, 503, 504})


class UploadProgress(Record):
    """The progress of an upload."""

    phase: Literal["hashing", "sending"]
    path: str = Field(description="file that is being worked on")
    done_bytes: int = Field(description="of all files; what the server knew already counts as sent")
    total_bytes: int


class UploadResult(Record):
    """The result of an upload."""

    id: str
    path: str = Field(description="what a job's option 'capture' takes")
    bytes: int = Field(description="size of the capture")
    sent_bytes: int = Field(description="sent by this call, bytes that had to be sent again included")
    left_out: tuple[str, ...] = Field(description="files of the folder that are no part of a capture")


class TransientError(Exception):
    """A fault that may pass after a while."""

    def __init__(self, message: str, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.wait_s = wait_s


class Uploader:
    """One upload, as a flow of requests."""

    def __init__(
        self, server: str, progress: Callable[[UploadProgress], None] | None = None, patience_s: float = PATIENCE_S
    ) -> None:
        self._server, self._progress, self._patience_s = server, progress, patience_s
        self._sent_bytes = self._done_bytes = self._total_bytes = 0
        self._chunk_bytes = CHUNK_BYTES

    def upload(self, folder: Path, subject: str | None = None) -> Flow[UploadResult]:
        """Upload a folder and commit it.

        Raises:
            CaptureInputError: the folder is no capture, or a file changes meanwhile. UploadError: the folder cannot be
                accepted, or the server refuses a part of it. PlatformError: no server answers.
        """
        if subject is not None and re.fullmatch(SUBJECT, subject) is None:
            raise UploadError(
                f"Subject {subject!r} is no label; use up to 64 letters, digits, dots, dashes and underscores, and no"
                " name."
            )
        files, left_out = yield BlockingCall(lambda: _scan(folder))
        yield BlockingCall(lambda: _require_no_metadata(folder, files))
        self._total_bytes = sum((folder / path).stat().st_size for path in files)
        hashed = yield BlockingCall(lambda: tuple(self._hashed(folder, path) for path in files))
        manifest = UploadManifest(files=hashed, subject=subject)
        document = yield from answer(self._server, HttpRequest("POST", "/captures", {"json": manifest.model_dump()}))
        capture = CaptureDetail.model_validate(document)
        self._done_bytes = self._total_bytes - capture.missing_bytes
        for file in capture.files:
            if not file.is_known:
                yield from self._send(folder / file.path, capture.id, file)
        yield from self._retry(lambda: self._answer("POST", f"/captures/{capture.id}/commit"))
        return UploadResult(
            id=capture.id, path=capture.path, bytes=capture.bytes, sent_bytes=self._sent_bytes, left_out=left_out
        )

    def _hashed(self, folder: Path, path: str) -> ManifestFile:
        content, size = hashlib.sha256(), 0
        with (folder / path).open("rb") as stream:
            while block := stream.read(CHUNK_BYTES):
                content.update(block)
                size += len(block)
                self._done_bytes += len(block)
                self._report("hashing", path)
        if size == 0:
            raise CaptureInputError(f"File {folder / path} is empty; leave it out or export it again.")
        return ManifestFile(path=path, bytes=size, sha256=content.hexdigest())

    def _send(self, source: Path, capture: str, file: CaptureFile) -> Flow[None]:
        from services.client.tus import VERSION, format_metadata

        url = file.upload.removeprefix("/v1")
        metadata = {
            "Upload-Length": str(file.bytes),
            "Upload-Metadata": format_metadata({"capture": capture, "path": file.path}),
        }
        created = yield from self._retry(
            lambda: self._answer("POST", "/uploads", headers={"Tus-Resumable": VERSION} | metadata)
        )
        base, offset = self._done_bytes - file.received_bytes, int(created.headers["Upload-Offset"])
        with source.open("rb") as stream:

            def step() -> Flow[int]:
                """Send one chunk and return the next offset; after a failure, ask the server for its offset first."""
                nonlocal offset
                start, offset = offset, -1
                if start < 0:
                    response = yield from self._answer("HEAD", url, headers={"Tus-Resumable": VERSION})
                    start = int(response.headers["Upload-Offset"])
                chunk, checksum = yield BlockingCall(
                    lambda: _read_chunk(stream, start, min(self._chunk_bytes, file.bytes - start))
                )
                if start < file.bytes and not chunk:
                    raise CaptureInputError(
                        f"File {source} became shorter while it was uploaded; upload the folder again."
                    )
                offset = yield from self._append(url, start, chunk, checksum)
                return offset

            while (yield from self._retry(step)) < file.bytes:
                self._done_bytes = base + offset
                self._report("sending", file.path)
        self._done_bytes = base + file.bytes
        self._report("sending", file.path)

    def _append(self, url: str, offset: int, chunk: bytes, checksum: str) -> Flow[int]:
        from services.client.tus import CHUNK_TYPE, VERSION

        headers = {
            "Tus-Resumable": VERSION,
            "Upload-Offset": str(offset),
            "Content-Type": CHUNK_TYPE,
            "Upload-Checksum": checksum,
        }
        self._sent_bytes += len(chunk)
        try:
            appended = yield from self._answer("PATCH", url, content=chunk, headers=headers)
        except TransientError:
            self._chunk_bytes = max(self._chunk_bytes // 2, MIN_CHUNK_BYTES)
            raise
        self._chunk_bytes = min(2 * self._chunk_bytes, CHUNK_BYTES)
        return int(appended.headers["Upload-Offset"])

    def _answer(self, method: str, path: str, **options: Any) -> Flow[httpx.Response]:
        """Make one request and return its response.

        Raises:
            TransientError: another try may succeed. DentineError: another try would fail too.
        """
        import httpx

        try:
            response: httpx.Response = yield HttpRequest(
                method, path, options | {"timeout": httpx.Timeout(10.0, read=VERIFYING_S, write=60.0)}
            )
        except httpx.TransportError as problem:
            raise TransientError(f"Server {self._server} does not answer ({problem})") from problem
        if not response.is_error:
            return response
        problem_code = "" if method == "HEAD" else response.text
        if response.status_code in _TRANSIENT_STATUSES or '"code":"upload-offset"' in problem_code:
            retry_after = response.headers.get("Retry-After", "")
            raise TransientError(
                f"Server {self._server} answers {response.status_code}",
                float(retry_after) if retry_after.isdigit() else None,
            )
        raise error_in(response)

    def _retry(self, step: Callable[[], Flow[R]]) -> Flow[R]:
        """Perform a step, and repeat it at growing intervals while its fault may pass.

        Raises:
            PlatformError: the fault has not passed in time.
        """
        give_up_s, wait_s = time.monotonic() + self._patience_s, MIN_WAIT_S
        while True:
            try:
                return (yield from step())
            except TransientError as problem:
                pause_s = problem.wait_s or wait_s * random.uniform(0.8, 1.2)
                if time.monotonic() + pause_s > give_up_s:
                    raise PlatformError(
                        f"{problem}; start it again and repeat this command, what was sent is kept."
                    ) from problem
            yield Pause(pause_s)
            wait_s = min(2 * wait_s, MAX_WAIT_S)

    def _report(self, phase: Literal["hashing", "sending"], path: str) -> None:
        if self._progress is not None:
            self._progress(
                UploadProgress(phase=phase, path=path, done_bytes=self._done_bytes, total_bytes=self._total_bytes)
            )


def _read_chunk(stream: BinaryIO, start: int, size: int) -> tuple[bytes, str]:
    """Read some bytes of a file; return them and their checksum as the value of a header."""
    from services.client.tus import Checksum, format_checksum

    stream.seek(start)
    chunk = stream.read(size)
    return chunk, format_checksum(Checksum("sha256", hashlib.sha256(chunk).digest()))


def _scan(folder: Path) -> tuple[list[str], tuple[str, ...]]:
    """The files of a folder that a capture may hold, and all others; symbolic links are among the others."""
    if not folder.is_dir():
        raise CaptureInputError(f"Capture {folder} is not a folder; give the folder that holds capture.json.")
    inside = sorted(_walk(folder, folder))
    files = [path for path, is_plain in inside if is_plain and path_fault(path) is None]
    require_paths(files)
    return files, tuple(path for path, is_plain in inside if not is_plain or path_fault(path) is not None)


def _require_no_metadata(folder: Path, files: list[str]) -> None:
    # The server refuses metadata too, but by then they have left this machine.
    for path in files:
        with suppress(ValueError):  # the server reports a file that is no valid image, with all other faults
            if (fault := metadata_fault(folder / path, path, PurePosixPath(path).suffix.lower())) is not None:
                raise UploadError(fault)


def _walk(root: Path, folder: Path) -> Iterator[tuple[str, bool]]:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            yield from _walk(root, path)
        else:
            yield path.relative_to(root).as_posix(), path.is_file() and not path.is_symlink()
