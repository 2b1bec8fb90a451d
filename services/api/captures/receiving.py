"""Writes the bytes of one upload request to disk, with bounded memory.

Blocks are appended after the recorded offset, made durable, and only then recorded. A request with a checksum is
recorded as a whole once the checksum is verified; without a checksum, the bytes that came before the connection broke
are kept.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from collections.abc import AsyncIterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass

from starlette.requests import ClientDisconnect

from services.api.captures.blobs import PartialFile, disk_full
from services.api.captures.uploads import Upload, Uploads
from services.api.http.awaited_threads import in_thread
from services.client.errors import ChecksumError, TooLargeError
from services.client.tus import Checksum
from services.core.errors import DentineError

BLOCK_BYTES = 2**20
RECORD_BYTES = 64 * 2**20
"""Number of bytes after which a long request is recorded, so that a server that dies loses no more of it."""
DRAIN_BYTES = 16 * 2**20
"""Number of bytes of a refused request that are read and dropped, so that its client reads the answer and not a broken
pipe."""


class ClientSilentError(Exception):
    """The client sent nothing for too long."""


@dataclass(frozen=True)
class Received:
    """Offset of an upload after a request, and the expiry of its capture as Unix time in s."""

    offset: int
    expires_s: float


async def receive(
    uploads: Uploads, capture: str, number: int, offset: int, stream: AsyncIterator[bytes], checksum: Checksum | None
) -> Received:
    """Append a request's bytes to an upload and verify the file once it is whole.

    Raises:
        LockedError, OffsetError, TooLargeError, ChecksumError, CorruptUploadError, DiskFullError: see ``Uploads`` and
            ``PartialFile``.
        ClientSilentError: nothing came for too long; what came before is kept as if the connection had broken.
    """
    body = _limit_silence(stream, uploads.limits.silence_s)
    try:
        with uploads.locks.hold(capture, number):
            upload = await in_thread(uploads.begin, capture, number, offset)
            result = (
                await _append(uploads, upload, body, checksum)
                if upload.missing_bytes
                else Received(offset, upload.expires_s)
            )
            if result.offset == upload.row.file.bytes:
                await in_thread(uploads.finish, upload.row)
            return result
    except DentineError:
        await _drain(body)
        raise


async def _append(uploads: Uploads, upload: Upload, body: AsyncIterator[bytes], checksum: Checksum | None) -> Received:
    with ExitStack() as opened:
        partial = await in_thread(_open, uploads, upload, opened)
        writer = _UploadWriter(uploads, upload, partial, checksum)
        try:
            async for chunk in body:
                writer.buffer += chunk
                if len(writer.buffer) >= BLOCK_BYTES:
                    await in_thread(writer.flush)
        except (ClientDisconnect, ClientSilentError):
            if checksum is None:
                await in_thread(writer.flush)
                await in_thread(writer.record)
            raise
        await in_thread(writer.flush)
        writer.require_checksum()
        return await in_thread(writer.record)


def _open(uploads: Uploads, upload: Upload, opened: ExitStack) -> PartialFile:
    """Open the file at its next byte. It is closed with ``opened``, also if the request is cancelled meanwhile."""
    try:
        return opened.enter_context(uploads.open_partial(upload))
    except OSError as problem:
        raise disk_full(problem) from problem


class _UploadWriter:
    """Appends the bytes of one request to an upload: they are buffered, then written, then recorded."""

    def __init__(self, uploads: Uploads, upload: Upload, partial: PartialFile, checksum: Checksum | None) -> None:
        self._uploads, self._upload, self._partial, self._checksum = uploads, upload, partial, checksum
        self._written = self._recorded = upload.offset
        self._hash = hashlib.new(checksum.algorithm, usedforsecurity=False) if checksum is not None else None
        self.buffer = bytearray()

    def flush(self) -> None:
        """Write the buffered bytes."""
        block, self.buffer = bytes(self.buffer), bytearray()
        file = self._upload.row.file
        if self._written + len(block) > file.bytes:
            raise TooLargeError(
                f"More bytes were sent of file {file.path!r} than the {file.bytes} of the manifest; send only what is"
                " missing."
            )
        self._partial.write(block)
        self._written += len(block)
        if self._hash is not None:
            self._hash.update(block)
        elif self._written - self._recorded >= RECORD_BYTES:
            self.record()

    def record(self) -> Received:
        """Make the written bytes durable and record them."""
        self._partial.sync()
        self._recorded = self._written
        return Received(self._written, self._uploads.record(self._upload, self._written))

    def require_checksum(self) -> None:
        """Refuse bytes that were altered on their way.

        Raises:
            ChecksumError: the bytes do not have the checksum that was sent with them.
        """
        if (
            self._hash is not None
            and self._checksum is not None
            and not hmac.compare_digest(self._hash.digest(), self._checksum.digest)
        ):
            raise ChecksumError(
                f"The bytes sent of file {self._upload.row.file.path!r} do not have the {self._checksum.algorithm} that"
                " was sent with them; send them again."
            )


async def _limit_silence(stream: AsyncIterator[bytes], silence_s: float) -> AsyncIterator[bytes]:
    while True:
        try:
            async with asyncio.timeout(silence_s):
                chunk = await anext(stream)
        except StopAsyncIteration:
            return
        except TimeoutError as problem:
            raise ClientSilentError from problem
        yield chunk


async def _drain(body: AsyncIterator[bytes]) -> None:
    dropped = 0
    with suppress(ClientDisconnect, ClientSilentError):
        async for chunk in body:
            dropped += len(chunk)
            if dropped > DRAIN_BYTES:
                break
