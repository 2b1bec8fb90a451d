"""Use cases of uploaded captures. The database holds offsets and states, the disk the contents; see ``blobs``.

::

    captures/<id>/     a committed capture: links to its contents, published by one rename
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import sqlalchemy as sql

from services.api.captures.blobs import Blobs, Write, sync_folders
from services.api.captures.descriptions import CaptureReader, InProcessReader
from services.api.captures.file_locks import FileLocks
from services.api.captures.uploads import Uploads, upload_path
from services.api.tables.captures import CaptureTable, FileRow, unknown_capture
from services.client.capture_paths import TEXTS, require_paths
from services.client.capture_records import (
    CaptureDetail,
    CaptureFile,
    CapturePage,
    CaptureState,
    FileFault,
    UploadManifest,
)
from services.client.errors import (
    CaptureStateError,
    CorruptUploadError,
    LockedError,
    TooLargeError,
    UnknownCaptureError,
)
from services.core.calibration.record import Calibration
from services.core.errors import DiskFullError, SettingsError
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.records import JobSpec
from services.core.settings import UploadLimits

FOLDER = "captures"
"""Folder of captures below the data folder. A job names an uploaded capture as ``captures/<id>``."""


@dataclass(frozen=True)
class CaptureCreation:
    """Result of announcing a capture: the capture, and whether it is new."""

    capture: CaptureDetail
    is_new: bool


def is_uploaded(path: Path) -> bool:
    """Whether a job's capture is named as an uploaded one, ``captures/<id>``."""
    return len(path.parts) == 2 and path.parts[0] == FOLDER


class Captures:
    """Use cases of captures in one data folder; there must be one instance per data folder.

    Args:
        now_s: returns Unix time in s.
        free_bytes: returns the free disk space of the data folder in bytes.
        write: writes bytes to a file descriptor and returns how many, like ``os.write``.
        reader: reads the contents of files.
    """

    def __init__(
        self,
        engine: sql.Engine,
        data: Path,
        limits: UploadLimits,
        now_s: Callable[[], float] = time.time,
        free_bytes: Callable[[], int] | None = None,
        write: Write = os.write,
        reader: CaptureReader | None = None,
    ) -> None:
        self._reader: CaptureReader = reader or InProcessReader()
        self._limits, self._data, self._now_s = limits, data, now_s
        self._table, self._blobs, self._locks = CaptureTable(engine), Blobs(data, write), FileLocks()
        self.uploads = Uploads(self._table, self._blobs, self._locks, limits, now_s)
        self._free_bytes = free_bytes or (lambda: shutil.disk_usage(data).free)
        self._lock = threading.RLock()

    def create(
        self, manifest: UploadManifest, key: str | None = None, viewer: Viewer = LOCAL_VIEWER
    ) -> CaptureCreation:
        """Open a capture, or find the one that its owner has opened already with this manifest or idempotency key.

        Raises:
            UploadError: a path that no capture may hold. TooLargeError: over a limit. CorruptUploadError: two files of
                one SHA-256 differ in size. CaptureStateError: the key belongs to another manifest.
            DiskFullError: too little free disk for it.
        """
        self._require_limits(manifest)
        require_paths(file.path for file in manifest.files)
        sizes: dict[str, int] = {}
        for file in manifest.files:
            if sizes.setdefault(file.sha256, file.bytes) != file.bytes:
                raise CorruptUploadError(
                    f"File {file.path} has the SHA-256 of another file of another size; hash the files again."
                )
        digest, key = manifest.digest(viewer.owner), viewer.key(key)
        with self._lock:
            self.sweep()
            if (earlier := self._table.find(digest, key)) is not None:
                return CaptureCreation(self.get(earlier.id), is_new=False)
            own = self._table.known((file.sha256 for file in manifest.files), viewer.owner)
            known = [file.sha256 in own and self._blobs.holds(file.sha256, file.bytes) for file in manifest.files]
            self._require_space(
                sum(file.bytes for file, is_known in zip(manifest.files, known, strict=True) if not is_known)
            )
            now_s = self._now_s()
            capture = self._table.insert(
                manifest, digest, key, known, now_s, now_s + self._limits.open_for_s, viewer.owner
            )
            return CaptureCreation(self.get(capture.id), is_new=True)

    def get(self, capture: str) -> CaptureDetail:
        """One capture with its files."""
        found = self._table.get(capture)
        files = tuple(self._file_detail(row) for row in self._table.files(capture))
        missing = sum(file.bytes - file.received_bytes for file in files)
        return CaptureDetail(**found.model_dump(), path=f"{FOLDER}/{capture}", missing_bytes=missing, files=files)

    def calibration(self, capture: str) -> Calibration:
        """Return the cameras and lights of a committed capture.

        Raises:
            UnknownCaptureError: there is no such capture. CaptureStateError: it is not committed. CaptureInputError:
                its description cannot be read.
        """
        if (state := self._table.get(capture).state) is not CaptureState.COMMITTED:
            raise CaptureStateError(
                f"Capture {capture} is {state}; commit it first with POST /v1/captures/{capture}/commit."
            )
        return self._reader.describe(self._data / FOLDER / capture).calibration

    def page(self, limit: int, before: int | None = None, viewer: Viewer = LOCAL_VIEWER) -> CapturePage:
        """Return up to ``limit`` captures that a viewer may see, newest first, of those with a number below
        ``before``.
        """
        found = self._table.page(limit + 1, before, None if viewer.sees_all else viewer.owner)
        return CapturePage(captures=found[:limit], next_before=found[limit - 1].number if len(found) > limit else None)

    def commit(self, capture: str) -> list[FileFault]:
        """Publish the capture's folder, or return the files that are missing, corrupt or refused.

        Committing again changes nothing.

        Raises:
            ExpiredError: the capture expired. LockedError: a file is still being sent. DiskFullError: the folder cannot
                be published.
        """
        if self._table.get(capture).state is CaptureState.COMMITTED:
            return []
        self.uploads.require_open(capture)
        rows = self._table.files(capture)
        if faults := [fault for row in rows if (fault := self._arrival_fault(row)) is not None]:
            return faults
        names = frozenset(row.file.path for row in rows)
        files = [(self._blobs.path(row.file.sha256), row.file.path) for row in rows]
        details = dict(self._reader.content_faults(files, self._limits, names))
        faults = [
            FileFault(path=row.file.path, kind="refused", detail=details[row.file.path])
            for row in rows
            if row.file.path in details
        ]
        if not faults:
            with self._lock:
                self.uploads.require_open(capture, or_committed=True)
                self._publish(capture, rows)
                self._table.change_state(capture, CaptureState.COMMITTED)
            self._blobs.discard_partial(capture)
        return faults

    def delete(self, capture: str) -> None:
        """Delete a capture that no job uses, with every content that no other capture has.

        Raises:
            CaptureStateError: a job uses it. LockedError: a file of it is being sent.
        """
        with self._lock:
            self._table.get(capture)
            if (job := self._table.job_with(f"{FOLDER}/{capture}")) is not None:
                raise CaptureStateError(f"Capture {capture} is used by job {job}; delete that job first.")
            if self._locks.holds_any(capture):
                raise LockedError(f"A file of capture {capture} is being sent; end that first.")
            self._retire(capture)
            self._table.delete(capture)

    def sweep(self) -> None:
        """Expire the captures that were not committed in time, and delete those that expired long ago."""
        with self._lock:
            now_s = self._now_s()
            for capture in self._table.in_state(CaptureState.OPEN, now_s):
                if not self._locks.holds_any(capture.id):
                    self._retire(capture.id)
            for capture in self._table.in_state(CaptureState.EXPIRED, now_s + self._limits.open_for_s):
                self._retire(capture.id)  # again, in case a server died in the middle of it
                if capture.expires_s < now_s - self._limits.open_for_s:
                    self._table.delete(capture.id)

    @contextmanager
    def holding(self, spec: JobSpec, viewer: Viewer = LOCAL_VIEWER) -> Iterator[None]:
        """Keep an uploaded capture from being deleted while a job that names it, as capture or mouth, is recorded;
        other paths pass.

        Raises:
            SettingsError: there is no such capture that the viewer may see, or it is not committed.
        """
        option, path = ("capture", spec.capture) if spec.rig is None else ("rig.mouth", spec.rig.mouth)
        with self._lock:
            if path is not None and is_uploaded(path):
                try:
                    found = self._table.get(path.name)
                    if not viewer.may_see(found.owner):
                        raise unknown_capture(path.name)
                except UnknownCaptureError as problem:
                    raise SettingsError(f"Option '{option}': {problem.message}") from problem
                if found.state is not CaptureState.COMMITTED:
                    what = (
                        f"capture {path.name} is {found.state}; commit it first with POST"
                        f" /v1/captures/{path.name}/commit"
                    )
                    raise SettingsError(f"Option '{option}': {what}.")
            yield

    def locate(self, spec: JobSpec) -> JobSpec:
        """Return the job with the folder of its uploaded capture, or of the uploaded mouth of its rig, instead of the
        name.
        """
        if spec.rig is not None and is_uploaded(spec.rig.mouth):
            return spec.model_copy(update={"rig": spec.rig.model_copy(update={"mouth": self._data / spec.rig.mouth})})
        if spec.capture is None or not is_uploaded(spec.capture):
            return spec
        return spec.model_copy(update={"capture": self._data / spec.capture})

    def subject_of(self, spec: JobSpec) -> str | None:
        """Label of the person in a job's uploaded capture; None without one, and of a capture by its path."""
        path = spec.capture if spec.rig is None else spec.rig.mouth
        if path is None or path.parent != self._data / FOLDER:
            return None
        return self._table.get(path.name).subject

    def _file_detail(self, row: FileRow) -> CaptureFile:
        is_known, received = self.uploads.is_known(row), self.uploads.received_bytes(row)
        return CaptureFile(
            **row.file.model_dump(),
            received_bytes=received,
            is_known=is_known,
            upload=upload_path(row.capture, row.number),
        )

    def _arrival_fault(self, row: FileRow) -> FileFault | None:
        file, received = row.file, self.uploads.received_bytes(row)
        if received == file.bytes:
            try:
                with self._locks.hold(row.capture, row.number):
                    self.uploads.finish(row)
            except CorruptUploadError as problem:
                return FileFault(path=file.path, kind="corrupt", detail=problem.message)
            return None
        if row.is_corrupt and received == 0:
            return FileFault(
                path=file.path,
                kind="corrupt",
                detail=f"File {file.path} was received with another SHA-256 than the manifest's; send it again.",
            )
        return FileFault(
            path=file.path,
            kind="missing",
            detail=f"File {file.path} is received up to byte {received} of {file.bytes}; send the rest.",
        )

    def _publish(self, capture: str, rows: list[FileRow]) -> None:
        final = self._data / FOLDER / capture
        if final.exists():
            return
        draft = final.with_name(f".{capture}.partial")
        shutil.rmtree(draft, ignore_errors=True)
        try:
            for row in rows:
                target = draft / row.file.path
                target.parent.mkdir(parents=True, exist_ok=True)
                target.hardlink_to(self._blobs.path(row.file.sha256))
            sync_folders(draft, *(path for path in draft.rglob("*") if path.is_dir()))
            draft.rename(final)
            sync_folders(final.parent)
        except OSError as problem:
            shutil.rmtree(draft, ignore_errors=True)
            raise DiskFullError(
                f"Capture {capture} cannot be published ({problem.strerror}); free some disk on the server and commit"
                " again."
            ) from problem

    def _retire(self, capture: str) -> None:
        """Mark a capture as expired, then remove its folder and every content that no other capture has. After an
        interruption at any point this can be repeated.
        """
        self._table.change_state(capture, CaptureState.EXPIRED)
        folder = self._data / FOLDER / capture
        retired = folder.with_name(f".{capture}.retired")
        if folder.exists():
            folder.rename(retired)
        shutil.rmtree(retired, ignore_errors=True)
        self._blobs.discard_partial(capture)
        contents = [row.file.sha256 for row in self._table.files(capture)]
        for sha256 in self._table.unreferenced(contents, besides=capture):
            self._blobs.remove(sha256)
        self._table.delete_files(capture)

    def _require_limits(self, manifest: UploadManifest) -> None:
        limits, files = self._limits, manifest.files
        if len(files) > limits.most_files:
            raise TooLargeError(
                f"The capture has {len(files)} files and {limits.most_files} are allowed; leave some out."
            )
        for file in files:
            largest = (
                limits.largest_text_bytes
                if PurePosixPath(file.path).suffix.lower() in TEXTS
                else limits.largest_file_bytes
            )
            if file.bytes > largest:
                raise TooLargeError(
                    f"File {file.path!r} has {file.bytes} bytes and {largest} are allowed; make it smaller."
                )
        if (total := sum(file.bytes for file in files)) > limits.largest_capture_bytes:
            raise TooLargeError(
                f"The capture has {total} bytes and {limits.largest_capture_bytes} are allowed; leave some files out."
            )

    def _require_space(self, missing_bytes: int) -> None:
        outstanding = self._table.outstanding_bytes()
        if (
            missing_bytes > 0
            and (free := self._free_bytes()) < missing_bytes + outstanding + self._limits.keep_free_bytes
        ):
            raise DiskFullError(
                f"The capture needs {missing_bytes} bytes of disk, and of {free} free ones {outstanding} are promised"
                f" to open captures and {self._limits.keep_free_bytes} kept back; free some space on the server, or"
                " delete captures."
            )
