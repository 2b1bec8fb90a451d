"""The database tables of uploaded captures and of their files."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sql

from services.api.tables.jobs import job_table
from services.client.capture_records import Capture, CaptureState, ManifestFile, UploadManifest
from services.client.errors import CaptureStateError, UnknownCaptureError
from services.core.owners import DEFAULT_GROUP
from services.pipeline.database import metadata, writing

capture_table = sql.Table(
    "capture",
    metadata,
    sql.Column("number", sql.Integer, primary_key=True),
    sql.Column("id", sql.Text, nullable=False, unique=True),
    sql.Column("key", sql.Text, unique=True),
    sql.Column("manifest", sql.Text, unique=True),  # null once expired, so that the same may be uploaded again
    sql.Column("state", sql.Text, nullable=False, index=True),
    sql.Column("subject", sql.Text),
    sql.Column("created_s", sql.Float, nullable=False),
    sql.Column("expires_s", sql.Float, nullable=False),
    sql.Column("file_count", sql.Integer, nullable=False),
    sql.Column("bytes", sql.BigInteger, nullable=False),
    sql.Column("owner", sql.Text, nullable=False, server_default=DEFAULT_GROUP),
    sql.Index("capture_of_owner", "owner", "number"),
    sqlite_autoincrement=True,
)
file_table = sql.Table(
    "capture_file",
    metadata,
    sql.Column("capture", sql.Text, primary_key=True),
    sql.Column("number", sql.Integer, primary_key=True, autoincrement=False),
    sql.Column("path", sql.Text, nullable=False),
    sql.Column("bytes", sql.BigInteger, nullable=False),
    sql.Column("sha256", sql.Text, nullable=False, index=True),
    sql.Column("received_bytes", sql.BigInteger, nullable=False),
    sql.Column("is_created", sql.Boolean, nullable=False),
    sql.Column("is_corrupt", sql.Boolean, nullable=False),
    sql.Column("is_known", sql.Boolean, nullable=False, server_default=sql.false()),
)
_BATCH = 500


@dataclass(frozen=True)
class FileRow:
    """One row of the table of files."""

    capture: str
    number: int
    file: ManifestFile
    received_bytes: int
    is_created: bool
    """Whether a client has asked for an upload of it and not terminated it."""
    is_corrupt: bool
    """Whether its content was received completely and did not have the SHA-256 of the manifest."""
    is_known: bool = False
    """Whether its owner has sent the whole content, for this capture or another one, and it was verified."""


def unknown_capture(capture: str) -> UnknownCaptureError:
    """Return the error for a capture that does not exist or belongs to another owner."""
    return UnknownCaptureError(f"There is no capture {capture!r}; list the captures to see their ids.")


class CaptureTable:
    """Rows of captures and of their files."""

    def __init__(self, engine: sql.Engine) -> None:
        self._engine = engine

    def find(self, manifest: str, key: str | None) -> Capture | None:
        """Find the capture of this manifest or of this idempotency key; both are specific to one owner. None if there
        is none.

        Raises:
            CaptureStateError: the key belongs to another manifest.
        """
        query = sql.select(capture_table).where(
            sql.or_(
                capture_table.c.manifest == manifest, capture_table.c.key == key if key is not None else sql.false()
            )
        )
        with self._engine.connect() as connection:
            rows = connection.execute(query).mappings().all()
        if any(row["key"] == key and row["manifest"] != manifest for row in rows if key is not None):
            shown = (key or "").partition("/")[2]
            raise CaptureStateError(f"Idempotency-Key {shown!r} was used for another manifest; choose a new key.")
        return _capture(rows[0]) if rows else None

    def insert(
        self,
        manifest: UploadManifest,
        digest: str,
        key: str | None,
        known: Sequence[bool],
        created_s: float,
        expires_s: float,
        owner: str = DEFAULT_GROUP,
    ) -> Capture:
        """Insert an open capture and its files.

        Args:
            digest: identifies the manifest and its owner.
            known: whether the owner has sent the content already, for each file.
            created_s: Unix time.
            expires_s: Unix time.
        """
        identity = secrets.token_hex(8)
        files = [
            {
                "capture": identity,
                "number": number,
                "received_bytes": file.bytes if is_known else 0,
                "is_known": is_known,
            }
            | {"is_created": False, "is_corrupt": False}
            | file.model_dump()
            for number, (file, is_known) in enumerate(zip(manifest.files, known, strict=True))
        ]
        row: dict[str, Any] = {
            "id": identity,
            "key": key,
            "manifest": digest,
            "state": CaptureState.OPEN,
            "subject": manifest.subject,
        }
        row |= {
            "created_s": created_s,
            "expires_s": expires_s,
            "file_count": len(files),
            "bytes": sum(file.bytes for file in manifest.files),
            "owner": owner,
        }
        with writing(self._engine) as connection:
            connection.execute(capture_table.insert().values(row))
            connection.execute(file_table.insert(), files)
        return self.get(identity)

    def get(self, capture: str) -> Capture:
        """One capture.

        Raises:
            UnknownCaptureError: there is none with this id.
        """
        row = None
        if capture.isascii() and capture.isalnum():
            with self._engine.connect() as connection:
                row = (
                    connection.execute(sql.select(capture_table).where(capture_table.c.id == capture))
                    .mappings()
                    .first()
                )
        if row is None:
            raise unknown_capture(capture)
        return _capture(row)

    def page(self, limit: int, before: int | None, owner: str | None = None) -> list[Capture]:
        """Return up to ``limit`` captures, newest first, of those with a number below ``before``; those of all owners
        unless one is named.
        """
        query = sql.select(capture_table).order_by(capture_table.c.number.desc()).limit(limit)
        if owner is not None:
            query = query.where(capture_table.c.owner == owner)
        if before is not None:
            query = query.where(capture_table.c.number < before)
        with self._engine.connect() as connection:
            return [_capture(row) for row in connection.execute(query).mappings()]

    def files(self, capture: str) -> list[FileRow]:
        """Return the files of a capture in the order of its manifest."""
        query = sql.select(file_table).where(file_table.c.capture == capture).order_by(file_table.c.number)
        with self._engine.connect() as connection:
            return [_file(row) for row in connection.execute(query).mappings()]

    def file(self, capture: str, number: int) -> FileRow:
        """One file.

        Raises:
            UnknownCaptureError: the capture has no file of this number.
        """
        query = sql.select(file_table).where(file_table.c.capture == capture, file_table.c.number == number)
        with self._engine.connect() as connection:
            row = connection.execute(query).mappings().first()
        if row is None:
            raise UnknownCaptureError(
                f"Capture {capture} has no file number {number}; ask for the capture to see its files."
            )
        return _file(row)

    def file_at(self, capture: str, path: str) -> FileRow:
        """One file by its path.

        Raises:
            UnknownCaptureError: the capture has no such file.
        """
        query = sql.select(file_table).where(file_table.c.capture == capture, file_table.c.path == path)
        with self._engine.connect() as connection:
            row = connection.execute(query).mappings().first()
        if row is None:
            raise UnknownCaptureError(f"Capture {capture} has no file {path!r}; its manifest says which it has.")
        return _file(row)

    def change_file(self, capture: str, number: int, expires_s: float | None = None, **columns: object) -> None:
        """Change a file's columns and, if it is given, the capture's expiry, in one transaction."""
        with writing(self._engine) as connection:
            connection.execute(
                file_table.update()
                .where(file_table.c.capture == capture, file_table.c.number == number)
                .values(columns)
            )
            if expires_s is not None:
                connection.execute(
                    capture_table.update().where(capture_table.c.id == capture).values(expires_s=expires_s)
                )

    def known(self, contents: Iterable[str], owner: str) -> set[str]:
        """Return those contents, by SHA-256, that an owner has sent completely."""
        requested, found = sorted(set(contents)), set[str]()
        own = sql.select(capture_table.c.id).where(capture_table.c.owner == owner)
        with self._engine.connect() as connection:
            for start in range(0, len(requested), _BATCH):
                of_batch = file_table.c.sha256.in_(requested[start : start + _BATCH])
                query = sql.select(file_table.c.sha256).where(
                    of_batch, file_table.c.is_known, file_table.c.capture.in_(own)
                )
                found.update(connection.scalars(query.distinct()))
        return found

    def mark_known(self, sha256: str, capture: str) -> None:
        """Record a content as received for every file that has it, in all captures of the owner of ``capture``."""
        owner = sql.select(capture_table.c.owner).where(capture_table.c.id == capture).scalar_subquery()
        own = sql.select(capture_table.c.id).where(capture_table.c.owner == owner)
        values = {"received_bytes": file_table.c.bytes, "is_corrupt": False, "is_known": True}
        with writing(self._engine) as connection:
            connection.execute(
                file_table.update().where(file_table.c.sha256 == sha256, file_table.c.capture.in_(own)).values(values)
            )

    def change_state(self, capture: str, state: CaptureState) -> None:
        """Set a capture's state; an expired one gives up its key and manifest."""
        values: dict[str, object] = {"state": state} | (
            {"key": None, "manifest": None} if state is CaptureState.EXPIRED else {}
        )
        with writing(self._engine) as connection:
            connection.execute(capture_table.update().where(capture_table.c.id == capture).values(values))

    def delete(self, capture: str) -> None:
        """Delete the rows of a capture and of its files."""
        with writing(self._engine) as connection:
            connection.execute(file_table.delete().where(file_table.c.capture == capture))
            connection.execute(capture_table.delete().where(capture_table.c.id == capture))

    def delete_files(self, capture: str) -> None:
        """Delete the rows of the files of a capture."""
        with writing(self._engine) as connection:
            connection.execute(file_table.delete().where(file_table.c.capture == capture))

    def in_state(self, state: CaptureState, expiring_before_s: float) -> list[Capture]:
        """Return the captures in a state that expire before a time."""
        query = sql.select(capture_table).where(
            capture_table.c.state == state, capture_table.c.expires_s < expiring_before_s
        )
        with self._engine.connect() as connection:
            return [_capture(row) for row in connection.execute(query).mappings()]

    def outstanding_bytes(self) -> int:
        """Return how many bytes all open captures have still to receive."""
        missing = sql.func.sum(file_table.c.bytes - file_table.c.received_bytes)
        query = (
            sql.select(missing)
            .join(capture_table, capture_table.c.id == file_table.c.capture)
            .where(capture_table.c.state == CaptureState.OPEN)
        )
        with self._engine.connect() as connection:
            return int(connection.scalar(query) or 0)

    def unreferenced(self, contents: Iterable[str], besides: str) -> set[str]:
        """Return those contents that no file of a capture other than ``besides`` has."""
        requested = sorted(set(contents))
        used: set[str] = set()
        with self._engine.connect() as connection:
            for start in range(0, len(requested), _BATCH):
                of_batch = file_table.c.sha256.in_(requested[start : start + _BATCH])
                used.update(
                    connection.scalars(
                        sql.select(file_table.c.sha256).where(of_batch, file_table.c.capture != besides).distinct()
                    )
                )
        return set(requested) - used

    def job_with(self, path: str) -> str | None:
        """Return the id of a job that names this capture; None if there is none."""
        query = sql.select(job_table.c.id).where(job_table.c.spec.like(f'%"{path}"%')).limit(1)
        with self._engine.connect() as connection:
            return connection.scalar(query)


def _capture(row: Any) -> Capture:
    return Capture(**{name: row[name] for name in Capture.model_fields})


def _file(row: Any) -> FileRow:
    file = ManifestFile(**{name: row[name] for name in ManifestFile.model_fields})
    return FileRow(
        row["capture"],
        row["number"],
        file,
        row["received_bytes"],
        row["is_created"],
        row["is_corrupt"],
        row["is_known"],
    )
