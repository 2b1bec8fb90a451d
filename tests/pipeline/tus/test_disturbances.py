"""Uploads over broken connections, silent clients, full disks and lost bytes."""

from __future__ import annotations

import errno
import hashlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.tus_world import CONTENT, CONTENTS, World, code_of, is_known
from tests.support.uploading import TUS, announce, checksum, offset_of, patch, upgraded


def wait_for_partial(data: Path, *, least_bytes: int = 0) -> None:
    """Wait until the server has begun to receive, and has written this many bytes."""
    while not any(path.is_file() and path.stat().st_size >= least_bytes for path in (data / "partial").rglob("*")):
        time.sleep(0.02)


def test_a_second_request_to_one_upload_is_refused(client: httpx.Client, upload: str, tmp_path: Path) -> None:
    has_begun, may_end = threading.Event(), threading.Event()

    def slowly() -> Iterator[bytes]:
        yield CONTENT[:1]
        has_begun.set()
        assert may_end.wait(30)
        yield CONTENT[1:]

    def first() -> None:
        with httpx.Client(base_url=client.base_url, trust_env=False) as other:
            answers.append(patch(other, upload, 0, slowly()).status_code)

    answers: list[int] = []
    thread = threading.Thread(target=first)
    thread.start()
    assert has_begun.wait(30)
    wait_for_partial(tmp_path)
    assert code_of(patch(client, upload, 0, CONTENT)) == (423, "upload-locked")
    assert code_of(client.delete(upload, headers=TUS)) == (423, "upload-locked")
    assert client.delete(f"/v1/captures/{upload.split('/')[-2]}").status_code == 423
    may_end.set()
    thread.join()
    assert answers == [204]
    assert is_known(client, upload)


@pytest.mark.parametrize("with_checksum", [False, True])
def test_a_broken_connection_keeps_what_came_unless_it_was_to_be_checked(
    client: httpx.Client, upload: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, with_checksum: bool
) -> None:
    monkeypatch.setattr("services.api.captures.receiving.BLOCK_BYTES", 1)
    host, port = client.base_url.host, client.base_url.port
    lines = [
        f"PATCH {upload} HTTP/1.1",
        f"Host: {host}:{port}",
        "Tus-Resumable: 1.0.0",
        "Upload-Offset: 0",
        f"Content-Length: {len(CONTENT)}",
    ]
    lines += ["Content-Type: application/offset+octet-stream"] + (
        [f"Upload-Checksum: {checksum(CONTENT)}"] if with_checksum else []
    )
    with socket.create_connection((host, port)) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode() + CONTENT[:1000])
        wait_for_partial(tmp_path, least_bytes=1000)  # the server drops what it has not read when a connection breaks
    while patch(client, upload, 1, b"").status_code == 423:
        time.sleep(0.02)
    assert offset_of(client, upload) == (0 if with_checksum else 1000)


@pytest.mark.attack("exhaustion", "an upload that falls silent")
def test_a_silent_client_is_told_and_loses_nothing(client: httpx.Client, upload: str) -> None:
    host, port = client.base_url.host, client.base_url.port
    lines = [
        f"PATCH {upload} HTTP/1.1",
        f"Host: {host}:{port}",
        "Tus-Resumable: 1.0.0",
        "Upload-Offset: 0",
        f"Content-Length: {len(CONTENT)}",
    ]
    with socket.create_connection((host, port)) as connection:
        connection.sendall(
            "\r\n".join([*lines, "Content-Type: application/offset+octet-stream", "", ""]).encode() + CONTENT[:1000]
        )
        assert connection.recv(100).startswith(b"HTTP/1.1 408")
    assert offset_of(client, upload) == 1000


def test_a_full_disk_is_a_507_and_keeps_what_was_acknowledged(client: httpx.Client, upload: str, world: World) -> None:
    assert patch(client, upload, 0, CONTENT[:1000]).status_code == 204
    world.room_bytes = 500
    assert code_of(patch(client, upload, 1000, CONTENT[1000:])) == (507, "disk-full")
    assert offset_of(client, upload) == 1000
    world.room_bytes = None
    assert patch(client, upload, 1000, CONTENT[1000:]).status_code == 204
    assert is_known(client, upload)


def test_a_disk_without_room_for_one_more_file_is_a_507_and_hangs_nobody(
    client: httpx.Client, upload: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: list[str] = []

    def truncate(_descriptor: int, _size: int) -> None:
        threads.append(threading.current_thread().name)
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(os, "ftruncate", truncate)
        assert code_of(patch(client, upload, 0, CONTENT)) == (507, "disk-full")
    assert [name.startswith("asyncio_") for name in threads] == [True], "the loop waited for the disk"
    assert patch(client, upload, 0, CONTENT).status_code == 204


def test_disk_promised_to_open_captures_is_not_promised_twice(client: httpx.Client, world: World) -> None:
    world.free_bytes = 2 * (2 + len(CONTENT)) + 9
    announce(client, CONTENTS)
    other: dict[str, Any] = {
        "files": [{"path": "capture.json", "bytes": 2 + len(CONTENT), "sha256": hashlib.sha256(b"other").hexdigest()}]
    }
    assert client.post("/v1/captures", json=other).json()["code"] == "disk-full"
    world.free_bytes += 1
    assert client.post("/v1/captures", json=other).status_code == 201


def test_what_lies_beyond_the_recorded_offset_is_cut_off(client: httpx.Client, upload: str, tmp_path: Path) -> None:
    patch(client, upload, 0, CONTENT[:1000])
    (partial,) = (path for path in (tmp_path / "partial").rglob("*") if path.is_file())
    partial.write_bytes(CONTENT[:1000] + b"never acknowledged" * 1000)
    assert offset_of(client, upload) == 1000
    assert patch(client, upload, 1000, CONTENT[1000:]).status_code == 204
    assert is_known(client, upload)


def test_bytes_that_the_disk_lost_are_asked_for_again(client: httpx.Client, upload: str, tmp_path: Path) -> None:
    patch(client, upload, 0, CONTENT[:1000])
    (partial,) = (path for path in (tmp_path / "partial").rglob("*") if path.is_file())
    os.truncate(partial, 300)
    assert offset_of(client, upload) == 300
    assert patch(client, upload, 300, CONTENT[300:]).status_code == 204
    assert is_known(client, upload)


def test_a_whole_file_that_was_never_verified_is_verified_by_an_empty_request(
    client: httpx.Client, upload: str, tmp_path: Path
) -> None:
    patch(client, upload, 0, CONTENT[:-1])
    (partial,) = (path for path in (tmp_path / "partial").rglob("*") if path.is_file())
    partial.write_bytes(CONTENT)
    import sqlalchemy as sql

    engine = upgraded(tmp_path / "db.sqlite")
    with engine.begin() as connection:
        connection.execute(sql.text("UPDATE capture_file SET received_bytes = bytes WHERE path = 'a.npy'"))
    engine.dispose()
    assert not is_known(client, upload)
    assert patch(client, upload, len(CONTENT), b"").status_code == 204
    assert is_known(client, upload)


def test_a_long_request_is_recorded_before_it_ends(
    client: httpx.Client, upload: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.api.captures.receiving.BLOCK_BYTES", 256)
    monkeypatch.setattr("services.api.captures.receiving.RECORD_BYTES", 1024)
    may_end = threading.Event()

    def slowly() -> Iterator[bytes]:
        for start in range(0, 2048, 256):
            yield CONTENT[start : start + 256]
        assert may_end.wait(30)
        yield CONTENT[2048:]

    def request() -> None:
        with httpx.Client(base_url=client.base_url, trust_env=False) as other:
            answers.append(patch(other, upload, 0, slowly()).status_code)

    answers: list[int] = []
    thread = threading.Thread(target=request)
    thread.start()
    while offset_of(client, upload) < 1024:
        time.sleep(0.02)
    may_end.set()
    thread.join()
    assert answers == [204]
    assert is_known(client, upload)
