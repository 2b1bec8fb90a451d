"""Loads on a server as processes of their own: ``python -m tests.benchmarks.dark_loads upload http://127.0.0.1:8000``;
they end by SIGTERM.

A load prints one line when it has begun to work.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import IO

import httpx

HALF_OPEN = 1500
UNFINISHED = b"GET /v1/health/live HTTP/1.1\r\nHost: 127.0.0.1\r\n"
"""Beginning of a request whose headers do not end."""
IMAGE_BYTES, CHUNK_BYTES = 16 * 2**20, 4 * 2**20
TEXT_BYTES = 2**20
"""Size of a ``capture.json``, which the server parses at the commit."""
FILES = 1600 + 500
"""File descriptors that the server and the process with the connections each need."""


@contextmanager
def loaded(load: str, address: str, log: IO[str]) -> Iterator[None]:
    """Put a load on a server for the time of the block."""
    command = [sys.executable, "-m", "tests.benchmarks.dark_loads", load, address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as process:
        try:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise RuntimeError(f"The load {load!r} ended at once; see server.log.")
            yield
        finally:
            process.terminate()


def allow_many_connections() -> None:
    """Raise the limit of open files for this process and those that it starts."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(
        resource.RLIMIT_NOFILE,
        (max(soft, FILES) if hard == resource.RLIM_INFINITY else min(max(soft, FILES), hard), hard),
    )


@cache
def tell_once() -> None:
    """Print, at the first call only, that the load has begun to work."""
    print("under way", flush=True)


def upload(address: str) -> None:
    """Send one capture after the other in large chunks, and commit each, so that the server checks it."""
    with httpx.Client(base_url=address, trust_env=False, timeout=120) as client:
        while True:
            text = json.dumps(
                {
                    "units": "mm",
                    "channels": [],
                    "cameras": [],
                    "lights": [],
                    "images": [],
                    "is": os.urandom(TEXT_BYTES // 2).hex(),
                }
            )
            files = {"capture.json": text.encode(), "image.npy": os.urandom(IMAGE_BYTES)}
            listed = [
                {"path": path, "bytes": len(body), "sha256": hashlib.sha256(body).hexdigest()}
                for path, body in files.items()
            ]
            with suppress(httpx.HTTPError, KeyError):
                capture = client.post("/v1/captures", json={"files": listed}).json()["id"]
                for number, (path, body) in enumerate(files.items()):
                    _send(client, capture, number, path, body)
                client.post(f"/v1/captures/{capture}/commit")
                client.delete(f"/v1/captures/{capture}")
            tell_once()


def _send(client: httpx.Client, capture: str, number: int, path: str, body: bytes) -> None:
    from services.client.tus import CHUNK_TYPE, VERSION, format_metadata

    metadata = format_metadata({"capture": capture, "path": path})
    client.post(
        "/v1/uploads", headers={"Tus-Resumable": VERSION, "Upload-Length": str(len(body)), "Upload-Metadata": metadata}
    )
    for start in range(0, len(body), CHUNK_BYTES):
        headers = {"Tus-Resumable": VERSION, "Upload-Offset": str(start), "Content-Type": CHUNK_TYPE}
        client.patch(f"/v1/uploads/{capture}/{number}", headers=headers, content=body[start : start + CHUNK_BYTES])


def half_open(address: str) -> None:
    """Hold ``HALF_OPEN`` connections with unfinished requests; those that the server closes are opened again."""
    host, port = address.removeprefix("http://").split(":")
    held: list[socket.socket] = []
    while True:
        while len(held) < HALF_OPEN:
            with suppress(OSError):
                connection = socket.create_connection((host, int(port)), timeout=10)
                connection.sendall(UNFINISHED)
                connection.setblocking(False)
                held.append(connection)
        tell_once()
        time.sleep(0.5)
        ended = [one for one in held if _has_ended(one)]
        for one in ended:
            one.close()
        held = [one for one in held if one not in set(ended)]


def _has_ended(connection: socket.socket) -> bool:
    try:
        connection.recv(4096)  # data or an end means that the server gave the unfinished request up
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


LOADS: dict[str, Callable[[str], None]] = {"upload": upload, "half-open": half_open}


if __name__ == "__main__":
    allow_many_connections()
    LOADS[sys.argv[1]](sys.argv[2])
