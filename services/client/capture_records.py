"""Records of uploaded captures, as the API shows them."""

from __future__ import annotations

import hashlib
import json
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from services.core.consent import SUBJECT
from services.core.geometry import Record
from services.core.owners import DEFAULT_GROUP

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class CaptureState(StrEnum):
    """Where an uploaded capture is in its life."""

    OPEN = "open"
    COMMITTED = "committed"
    EXPIRED = "expired"


class ManifestFile(Record):
    """One file of a capture, as the client has it."""

    path: str = Field(description="relative to the capture's folder, parts separated by '/'")
    bytes: int = Field(ge=1, le=2**53, description="size")
    sha256: Sha256 = Field(description="of the content, in lower-case hexadecimal digits")


class UploadManifest(Record):
    """What a client wants to upload."""

    files: tuple[ManifestFile, ...] = Field(min_length=1, fail_fast=True, description="every file of the capture")
    subject: str | None = Field(
        default=None, pattern=f"^{SUBJECT}$", description="pseudonymous label of the person; never a name"
    )

    def digest(self, owner: str = DEFAULT_GROUP) -> str:
        """A digest of the files in any order, the subject and the owner."""
        rows = sorted((file.path, file.bytes, file.sha256) for file in self.files)
        owner_part = (
            [] if owner == DEFAULT_GROUP else [owner]
        )  # the same digest as in version 0.1, which knew no owners
        return hashlib.sha256(json.dumps([self.subject, rows, *owner_part]).encode()).hexdigest()


class CaptureFile(ManifestFile):
    """One file of a capture, as the server has it."""

    received_bytes: int = Field(description="bytes that need not be sent again")
    is_known: bool = Field(description="whether the whole content is here and verified; nothing is missing then")
    upload: str = Field(
        description="where to send what is missing, by tus; create the upload there first with POST /v1/uploads"
    )


class Capture(Record):
    """An uploaded capture without its files."""

    id: str
    number: int = Field(description="grows with every capture")
    state: CaptureState
    subject: str | None = Field(description="pseudonymous label of the person")
    created_s: float = Field(description="Unix time")
    expires_s: float = Field(
        description="Unix time at which it expires if it is still open; later with every byte received"
    )
    file_count: int
    bytes: int = Field(description="size of all files together")
    owner: str = Field(default=DEFAULT_GROUP, description="group that it belongs to, or token:ID of a token in none")


class CaptureDetail(Capture):
    """An uploaded capture with its files."""

    path: str = Field(description="what a job's option 'capture' takes, once the capture is committed")
    missing_bytes: int = Field(description="still to be received")
    files: tuple[CaptureFile, ...]


class CapturePage(Record):
    """Some captures, newest first."""

    captures: list[Capture]
    next_before: int | None = Field(description="give as 'before' to get the next page; null on the last")


class FileFault(Record):
    """Why a file keeps its capture from being committed."""

    path: str
    kind: Literal["missing", "corrupt", "refused"] = Field(
        description="not all received; not what the manifest says; or content that is not accepted"
    )
    detail: str = Field(description="one sentence that names the file and the remedy")
