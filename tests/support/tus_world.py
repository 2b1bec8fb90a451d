"""The clock and the disk of a server as a test of uploads controls them, and requests that such tests share."""

from __future__ import annotations

import errno
import os

import httpx

CONTENT = bytes(range(256)) * 16
CONTENTS = {"capture.json": b"{}", "a.npy": CONTENT}


class World:
    """The server's clock and disk.

    Attributes:
        now_s: Unix time.
        free_bytes: free space that the server is told.
        room_bytes: bytes that can still be written; None for no limit.
    """

    def __init__(self) -> None:
        self.now_s = 1e9
        self.free_bytes = 2**40
        self.room_bytes: int | None = None

    def write(self, descriptor: int, block: memoryview) -> int:
        """Write like ``os.write`` while there is room; with none left, raise ENOSPC."""
        if self.room_bytes is None:
            return os.write(descriptor, block)
        if self.room_bytes == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = os.write(descriptor, block[: self.room_bytes])
        self.room_bytes -= written
        return written


def code_of(answer: httpx.Response) -> tuple[int, str]:
    assert answer.headers["tus-resumable"] == "1.0.0"
    assert answer.headers["content-type"] == "application/problem+json"
    return answer.status_code, answer.json()["code"]


def is_known(client: httpx.Client, upload: str) -> bool:
    capture, number = upload.split("/")[-2:]
    return bool(client.get(f"/v1/captures/{capture}").json()["files"][int(number)]["is_known"])
