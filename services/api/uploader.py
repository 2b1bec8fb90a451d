"""Sends a folder to a server, file by file and chunk by chunk. All state is the server's, so any later process goes on where this one ends."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pydantic import Field

from services.api.capture_paths import path_fault, require_paths
from services.api.capture_records import SUBJECT, CaptureDetail, CaptureFile, ManifestFile, UploadManifest
from services.core.errors import CaptureInputError, PlatformError, UploadError
from services.core.geometry import Record

if TYPE_CHECKING:
    import httpx

R = TypeVar("R")
CHUNK_BYTES = 4 * 2**20
LEAST_CHUNK_BYTES = 2**18
"""A chunk is recorded whole or not at all; one that failed is halved down to this, so that a bad connection still gets on."""
PATIENCE_S = 300.0
"""How long a chunk is tried again while the server does not answer."""
VERIFYING_S = 900.0
"""How long the server may take to answer, as after the last chunk it reads the whole file."""
_PASSING = frozenset({408, 423, 429, 460, 502, 503, 504})


class UploadProgress(Record):
    """How far an upload is."""

    phase: Literal["hashing", "sending"]
    path: str = Field(description="file that is being worked on")
    done_bytes: int = Field(description="of all files; what the server knew already counts as sent")
    total_bytes: int


class UploadResult(Record):
    """What an upload led to."""

    id: str
    path: str = Field(description="what a job's option 'capture' takes")
    bytes: int = Field(description="size of the capture")
    sent_bytes: int = Field(description="sent by this call, bytes that had to be sent again included")
    left_out: tuple[str, ...] = Field(description="files of the folder that are no part of a capture")


class PassingError(Exception):
    """Something that may be over after a while."""

    def __init__(self, message: str, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.wait_s = wait_s


class Uploader:
    """One upload over one connection."""

    def __init__(
        self, http: httpx.Client, ask: Callable[..., dict[str, Any]], progress: Callable[[UploadProgress], None] | None = None, patience_s: float = PATIENCE_S
    ) -> None:
        self._http, self._ask, self._progress, self._patience_s = http, ask, progress, patience_s
        self._sent_bytes = self._done_bytes = self._total_bytes = 0
        self._chunk_bytes = CHUNK_BYTES

    def upload(self, folder: Path, subject: str | None = None) -> UploadResult:
        """Upload a folder and commit it.

        Raises:
            CaptureInputError: the folder is no capture, or a file changes meanwhile. UploadError: what the server refuses. PlatformError: no server answers.
        """
        if subject is not None and re.fullmatch(SUBJECT, subject) is None:
            raise UploadError(f"Subject {subject!r} is no label; use up to 64 letters, digits, dots, dashes and underscores, and no name.")
        files, left_out = _scan(folder)
        self._total_bytes = sum((folder / path).stat().st_size for path in files)
        manifest = UploadManifest(files=tuple(self._hashed(folder, path) for path in files), subject=subject)
        capture = CaptureDetail.model_validate(self._ask("POST", "/captures", json=manifest.model_dump()))
        self._done_bytes = self._total_bytes - capture.missing_bytes
        for file in capture.files:
            if not file.is_known:
                self._send(folder / file.path, capture.id, file)
        self._patiently(lambda: self._answer("POST", f"/captures/{capture.id}/commit"))
        return UploadResult(id=capture.id, path=capture.path, bytes=capture.bytes, sent_bytes=self._sent_bytes, left_out=left_out)

    def _hashed(self, folder: Path, path: str) -> ManifestFile:
        content, size = hashlib.sha256(), 0
        with (folder / path).open("rb") as stream:
            while block := stream.read(CHUNK_BYTES):
                content.update(block)
                size += len(block)
                self._done_bytes += len(block)
                self._tell("hashing", path)
        if size == 0:
            raise CaptureInputError(f"File {folder / path} is empty; leave it out or export it again.")
        return ManifestFile(path=path, bytes=size, sha256=content.hexdigest())

    def _send(self, source: Path, capture: str, file: CaptureFile) -> None:
        from services.api.tus import VERSION, format_metadata

        url = file.upload.removeprefix("/v1")
        metadata = {"Upload-Length": str(file.bytes), "Upload-Metadata": format_metadata({"capture": capture, "path": file.path})}
        created = self._patiently(lambda: self._answer("POST", "/uploads", headers={"Tus-Resumable": VERSION} | metadata))
        base, offset = self._done_bytes - file.received_bytes, int(created.headers["Upload-Offset"])
        with source.open("rb") as stream:

            def step() -> int:
                """The next offset after one more chunk; a failed one asks the server for its own first."""
                nonlocal offset
                start, offset = offset, -1
                if start < 0:
                    start = int(self._answer("HEAD", url, headers={"Tus-Resumable": VERSION}).headers["Upload-Offset"])
                stream.seek(start)
                chunk = stream.read(min(self._chunk_bytes, file.bytes - start))
                if start < file.bytes and not chunk:
                    raise CaptureInputError(f"File {source} became shorter while it was uploaded; upload the folder again.")
                offset = self._append(url, start, chunk)
                return offset

            while self._patiently(step) < file.bytes:
                self._done_bytes = base + offset
                self._tell("sending", file.path)
        self._done_bytes = base + file.bytes
        self._tell("sending", file.path)

    def _append(self, url: str, offset: int, chunk: bytes) -> int:
        from services.api.tus import CHUNK_TYPE, VERSION, Checksum, format_checksum

        checksum = format_checksum(Checksum("sha256", hashlib.sha256(chunk).digest()))
        headers = {"Tus-Resumable": VERSION, "Upload-Offset": str(offset), "Content-Type": CHUNK_TYPE, "Upload-Checksum": checksum}
        self._sent_bytes += len(chunk)
        try:
            answer = self._answer("PATCH", url, content=chunk, headers=headers)
        except PassingError:
            self._chunk_bytes = max(self._chunk_bytes // 2, LEAST_CHUNK_BYTES)
            raise
        self._chunk_bytes = min(2 * self._chunk_bytes, CHUNK_BYTES)
        return int(answer.headers["Upload-Offset"])

    def _answer(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask once.

        Raises:
            PassingError: worth another try. DentineError: not.
        """
        import httpx

        from services.api.client import error_in

        try:
            response = self._http.request(method, path, timeout=httpx.Timeout(10.0, read=VERIFYING_S, write=60.0), **options)
        except httpx.TransportError as problem:
            raise PassingError(f"Server {self._http.base_url} does not answer ({problem})") from problem
        if not response.is_error:
            return response
        problem_code = "" if method == "HEAD" else response.text
        if response.status_code in _PASSING or '"code":"upload-offset"' in problem_code:
            wait = response.headers.get("Retry-After", "")
            raise PassingError(f"Server {self._http.base_url} answers {response.status_code}", float(wait) if wait.isdigit() else None)
        raise error_in(response)

    def _patiently(self, step: Callable[[], R]) -> R:
        import stamina

        def is_passing(problem: Exception) -> bool | float:
            return isinstance(problem, PassingError) and (problem.wait_s or True)

        try:
            for attempt in stamina.retry_context(on=is_passing, attempts=None, timeout=self._patience_s, wait_initial=0.2, wait_max=5.0, wait_jitter=0.2):
                with attempt:
                    return step()
        except PassingError as problem:
            raise PlatformError(f"{problem}; start it again and repeat this command, what was sent is kept.") from problem
        raise AssertionError("a retry ends by returning or raising")

    def _tell(self, phase: Literal["hashing", "sending"], path: str) -> None:
        if self._progress is not None:
            self._progress(UploadProgress(phase=phase, path=path, done_bytes=self._done_bytes, total_bytes=self._total_bytes))


def _scan(folder: Path) -> tuple[list[str], tuple[str, ...]]:
    """Files that a capture may hold, and the others; a link is an other."""
    if not folder.is_dir():
        raise CaptureInputError(f"Capture {folder} is not a folder; give the folder that holds capture.json.")
    inside = sorted(_walk(folder, folder))
    files = [path for path, is_plain in inside if is_plain and path_fault(path) is None]
    require_paths(files)
    return files, tuple(path for path, is_plain in inside if not is_plain or path_fault(path) is not None)


def _walk(root: Path, folder: Path) -> Iterator[tuple[str, bool]]:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            yield from _walk(root, path)
        else:
            yield path.relative_to(root).as_posix(), path.is_file() and not path.is_symlink()
