"""The upload of one file of a capture: its recorded state, and the steps that the state allows.

``receiving`` moves the bytes, ``tus_routes`` speaks the protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from services.api.captures.blobs import Blobs, PartialFile
from services.api.captures.file_locks import FileLocks
from services.api.tables.captures import CaptureTable, FileRow, unknown_capture
from services.client.capture_records import CaptureState
from services.client.errors import CaptureStateError, CorruptUploadError, ExpiredError, OffsetError, UnknownCaptureError
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.settings import UploadLimits


def upload_path(capture: str, number: int) -> str:
    """Return the path to which a file of a capture is sent."""
    return f"/v1/uploads/{capture}/{number}"


@dataclass(frozen=True)
class Upload:
    """A file that is being received."""

    row: FileRow
    offset: int
    """Number of bytes that are received and need not be sent again."""
    expires_s: float

    @property
    def missing_bytes(self) -> int:
        """Number of bytes that are still to be sent."""
        return self.row.file.bytes - self.offset


class Uploads:
    """The uploads of one server. An offset is recorded only once its bytes are durable, so that a server that dies
    loses no acknowledged byte.
    """

    def __init__(
        self, table: CaptureTable, blobs: Blobs, locks: FileLocks, limits: UploadLimits, now_s: Callable[[], float]
    ) -> None:
        self.limits, self.locks = limits, locks
        self._table, self._blobs, self._now_s = table, blobs, now_s

    def create(self, capture: str, path: str, size_bytes: int, viewer: Viewer = LOCAL_VIEWER) -> Upload:
        """Create the upload of one file of a capture that the viewer may see. Creating it again changes nothing.

        Raises:
            UnknownCaptureError: no such capture or file. CorruptUploadError: its size is not that of the manifest.
                ExpiredError, CaptureStateError: the capture is not open.
        """
        if not viewer.may_see(self._table.get(capture).owner):
            raise unknown_capture(capture)
        self.require_open(capture)
        row = self._table.file_at(capture, path)
        if row.file.bytes != size_bytes:
            raise CorruptUploadError(
                f"File {path!r} has {row.file.bytes} bytes by the manifest and {size_bytes} by Upload-Length; correct"
                " the wrong one."
            )
        self._table.change_file(capture, row.number, is_created=True)
        return self.find(capture, row.number)

    def find(self, capture: str, number: int) -> Upload:
        """Return an upload that was created, with its offset.

        Raises:
            UnknownCaptureError: no such capture or file, or no upload of it. ExpiredError: the capture expired.
        """
        self.require_open(capture, or_committed=True)
        row = self._table.file(capture, number)
        if not row.is_created:
            raise UnknownCaptureError(
                f"File {row.file.path!r} of capture {capture} has no upload; create it with POST /v1/uploads."
            )
        return Upload(row, self.received_bytes(row), self._table.get(capture).expires_s)

    def begin(self, capture: str, number: int, offset: int) -> Upload:
        """Return the upload if its next byte is at this offset. The caller must hold the file's lock.

        Raises:
            OffsetError: the offset of the next byte is another one. CaptureStateError: the capture is committed.
        """
        self.require_open(capture)
        upload = self.find(capture, number)
        if upload.offset != offset:
            raise OffsetError(
                f"File {upload.row.file.path!r} is here up to byte {upload.offset}, not {offset}; ask for Upload-Offset"
                " and send from there."
            )
        return upload

    def open_partial(self, upload: Upload) -> PartialFile:
        """Open the file of an upload at its next byte."""
        return self._blobs.open_partial(upload.row.capture, upload.row.number, upload.offset)

    def record(self, upload: Upload, offset: int) -> float:
        """Record up to which offset bytes are durably on disk; returns the new expiry of the capture as Unix time in
        s.
        """
        expires_s = self._now_s() + self.limits.open_for_s
        self._table.change_file(upload.row.capture, upload.row.number, expires_s, received_bytes=offset)
        return expires_s

    def finish(self, row: FileRow) -> None:
        """Verify a file of which every byte is received. The caller must hold its lock.

        Raises:
            CorruptUploadError: its SHA-256 is not that of the manifest; the received bytes are discarded.
        """
        file = row.file
        if not self.is_known(row) and not self._blobs.adopt(row.capture, row.number, file.sha256):
            self._table.change_file(row.capture, row.number, received_bytes=0, is_corrupt=True)
            raise CorruptUploadError(
                f"File {file.path!r} was received whole, but its SHA-256 is not the manifest's; it was discarded, so"
                " send it again."
            )
        self._table.mark_known(file.sha256, row.capture)
        self._blobs.discard_partial(row.capture, row.number)

    def terminate(self, capture: str, number: int) -> None:
        """Discard the received bytes of a file, and its upload.

        Raises:
            LockedError: it is being sent. CaptureStateError: the capture is committed.
        """
        self.require_open(capture)
        with self.locks.hold(capture, number):
            row = self.find(capture, number).row
            self._blobs.discard_partial(capture, number)
            self._table.change_file(
                capture, number, is_created=False, received_bytes=row.file.bytes if self.is_known(row) else 0
            )

    def is_known(self, row: FileRow) -> bool:
        """Whether the content is stored and verified, and the owner of the capture has sent it.

        A content that only others have sent must be sent again: somebody who knows nothing but its SHA-256 must neither
        get it nor learn that it is stored.
        """
        return row.is_known and self._blobs.holds(row.file.sha256, row.file.bytes)

    def received_bytes(self, row: FileRow) -> int:
        """Return the recorded number of received bytes, but never more than the disk holds."""
        if self.is_known(row):
            return row.file.bytes
        return min(row.received_bytes, self._blobs.received_bytes(row.capture, row.number))

    def require_open(self, capture: str, *, or_committed: bool = False) -> None:
        """Refuse a capture that takes no bytes.

        Raises:
            UnknownCaptureError: there is none. ExpiredError: it was not committed in time. CaptureStateError: it is
                committed.
        """
        found = self._table.get(capture)
        if found.state is CaptureState.EXPIRED or (
            found.state is CaptureState.OPEN and found.expires_s < self._now_s()
        ):
            raise ExpiredError(f"Capture {capture} was not committed in time and has expired; upload it again.")
        if found.state is CaptureState.COMMITTED and not or_committed:
            raise CaptureStateError(
                f"Capture {capture} is committed and takes no more bytes; upload changed files as a new capture."
            )
