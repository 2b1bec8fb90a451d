"""What a test of uploads can change about the server's world, and what it asks of the server."""

from __future__ import annotations

import errno
import os

import httpx

CONTENT = bytes(range(256)) * 16
CONTENTS = {"capture.json": b"{}", "a.npy": CONTENT}


class World:
    """What the server cannot choose: time and the disk."""

    def __init__(self) -> None:
        self.now_s = 1e9
        self.free_bytes = 2**40
        self.room_bytes: int | None = None

    def write(self, descriptor: int, block: memoryview) -> int:
        """Like os.write until the disk has no room left."""
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
