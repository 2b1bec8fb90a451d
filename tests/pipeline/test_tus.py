"""The tus protocol, request by request, on the application's own routes with a clock and a disk of the test's."""

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
from fastapi import FastAPI

from services.api.auth.install import install
from services.api.captures.captures import Captures
from services.api.captures.routes import build_captures_router
from services.api.http import problems
from services.api.http.thread_pools import ThreadPool
from services.core.settings import ServerSettings, UploadLimits
from tests.support.live_server import serving
from tests.support.uploading import TUS, announce, checksum, create_upload, offset_of, patch, upgraded

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


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def client(tmp_path: Path, world: World) -> Iterator[httpx.Client]:
    engine = upgraded(tmp_path / "db.sqlite")
    limits = UploadLimits(open_for_s=100, silence_s=2, keep_free_bytes=10)
    app = FastAPI()
    app.state.parsers = ThreadPool(1)
    problems.install(app)
    captures = Captures(engine, tmp_path, limits, lambda: world.now_s, lambda: world.free_bytes, world.write)
    app.include_router(build_captures_router(captures))
    install(app, ServerSettings(data=tmp_path), engine, ThreadPool(1), ThreadPool(1))
    with serving(app) as connected:
        yield connected
    engine.dispose()


@pytest.fixture
def upload(client: httpx.Client) -> str:
    return create_upload(client, announce(client, CONTENTS)["id"], "a.npy", CONTENT)


def code_of(answer: httpx.Response) -> tuple[int, str]:
    assert answer.headers["tus-resumable"] == "1.0.0"
    assert answer.headers["content-type"] == "application/problem+json"
    return answer.status_code, answer.json()["code"]


def wait_for_partial(data: Path) -> None:
    """Until the server has begun to receive."""
    while not any(path.is_file() for path in (data / "partial").rglob("*")):
        time.sleep(0.02)


def is_known(client: httpx.Client, upload: str) -> bool:
    capture, number = upload.split("/")[-2:]
    return bool(client.get(f"/v1/captures/{capture}").json()["files"][int(number)]["is_known"])


def test_options_tell_what_is_spoken(client: httpx.Client) -> None:
    answer = client.options("/v1/uploads")
    assert answer.status_code == 204
    assert answer.headers["tus-version"] == "1.0.0"
    assert set(answer.headers["tus-extension"].split(",")) == {"creation", "termination", "expiration", "checksum"}
    assert set(answer.headers["tus-checksum-algorithm"].split(",")) == {"sha256", "sha1"}
    assert int(answer.headers["tus-max-size"]) == UploadLimits().largest_file_bytes


def test_a_file_is_sent_in_parts(client: httpx.Client, upload: str) -> None:
    for offset in range(0, len(CONTENT), 1000):
        assert offset_of(client, upload) == offset
        assert not is_known(client, upload)
        answer = patch(client, upload, offset, CONTENT[offset : offset + 1000])
        assert (answer.status_code, answer.headers["upload-offset"]) == (204, str(min(offset + 1000, len(CONTENT))))
    assert is_known(client, upload)
    head = client.head(upload, headers=TUS)
    assert (head.headers["upload-length"], head.headers["upload-offset"], head.headers["cache-control"]) == (
        "4096",
        "4096",
        "no-store",
    )


def test_creating_again_keeps_what_was_received(client: httpx.Client, upload: str) -> None:
    patch(client, upload, 0, CONTENT[:10])
    capture = upload.split("/")[-2]
    assert create_upload(client, capture, "a.npy", CONTENT) == upload
    assert offset_of(client, upload) == 10


@pytest.mark.parametrize("offset", [0, 9, 11, 4096])
def test_a_wrong_offset_is_refused_and_changes_nothing(client: httpx.Client, upload: str, offset: int) -> None:
    patch(client, upload, 0, CONTENT[:10])
    assert code_of(patch(client, upload, offset, b"x")) == (409, "upload-offset")
    assert offset_of(client, upload) == 10


@pytest.mark.parametrize("version", [None, "0.2.2"])
@pytest.mark.parametrize("method", ["POST", "HEAD", "PATCH", "DELETE"])
def test_another_protocol_version_is_refused(
    client: httpx.Client, upload: str, method: str, version: str | None
) -> None:
    url = "/v1/uploads" if method == "POST" else upload
    answer = client.request(method, url, headers={"Tus-Resumable": version} if version else {})
    assert (answer.status_code, answer.headers["tus-version"]) == (412, "1.0.0")


def test_another_content_type_is_refused(client: httpx.Client, upload: str) -> None:
    assert patch(client, upload, 0, CONTENT, **{"Content-Type": "text/plain"}).status_code == 415
    assert offset_of(client, upload) == 0


@pytest.mark.parametrize("algorithm", ["sha256", "sha1"])
def test_a_checksum_is_checked_before_anything_is_recorded(client: httpx.Client, upload: str, algorithm: str) -> None:
    altered = patch(client, upload, 0, CONTENT[:99] + b"\0", **{"Upload-Checksum": checksum(CONTENT[:100], algorithm)})
    assert code_of(altered) == (460, "upload-checksum")
    assert "a.npy" in altered.json()["detail"]
    assert offset_of(client, upload) == 0
    assert (
        patch(client, upload, 0, CONTENT[:100], **{"Upload-Checksum": checksum(CONTENT[:100], algorithm)}).status_code
        == 204
    )
    assert patch(client, upload, 100, CONTENT[100:]).status_code == 204
    assert is_known(client, upload)


@pytest.mark.parametrize("header", ["md5 AAAA", "sha256", "sha256 AAAA", "sha256 ???", ""])
def test_a_malformed_checksum_is_refused(client: httpx.Client, upload: str, header: str) -> None:
    assert code_of(patch(client, upload, 0, CONTENT, **{"Upload-Checksum": header})) == (422, "upload-refused")
    assert offset_of(client, upload) == 0


@pytest.mark.parametrize(
    "metadata",
    [
        "",
        "capture",
        "capture ???",
        "path YQ==",
        "capture YQ==,capture YQ==",
        "capture /w==,path YQ==",
        "capture YQ==,path AA==",
    ],
)
def test_malformed_metadata_is_refused(client: httpx.Client, metadata: str) -> None:
    answer = client.post("/v1/uploads", headers=TUS | {"Upload-Length": "1", "Upload-Metadata": metadata})
    assert code_of(answer) == (422, "upload-refused")


def test_only_files_of_the_manifest_are_taken(client: httpx.Client) -> None:
    from services.client.tus import format_metadata

    capture = announce(client, CONTENTS)["id"]
    other = client.post(
        "/v1/uploads",
        headers=TUS | {"Upload-Length": "1", "Upload-Metadata": format_metadata({"capture": capture, "path": "b.npy"})},
    )
    assert code_of(other) == (404, "capture-unknown")
    longer = client.post(
        "/v1/uploads",
        headers=TUS | {"Upload-Length": "9", "Upload-Metadata": format_metadata({"capture": capture, "path": "a.npy"})},
    )
    assert code_of(longer) == (422, "upload-corrupt")
    assert client.head(f"/v1/uploads/{capture}/1", headers=TUS).status_code == 404


@pytest.mark.attack("uploads", "more bytes than were announced")
def test_more_bytes_than_the_manifest_says_are_refused(client: httpx.Client, upload: str) -> None:
    assert code_of(patch(client, upload, 0, CONTENT + b"x")) == (413, "upload-too-large")
    assert not is_known(client, upload)
    assert patch(client, upload, 0, CONTENT).status_code == 204


@pytest.mark.attack("uploads", "other bytes than were announced")
def test_a_finished_file_with_another_sha256_is_refused_by_name_and_can_be_sent_again(
    client: httpx.Client, upload: str, tmp_path: Path
) -> None:
    answer = patch(client, upload, 0, CONTENT[:-1] + b"\0")
    assert code_of(answer) == (422, "upload-corrupt")
    assert "'a.npy'" in answer.json()["detail"]
    assert offset_of(client, upload) == 0
    assert [path for folder in ("partial", "blobs") for path in (tmp_path / folder).rglob("*") if path.is_file()] == []
    assert patch(client, upload, 0, CONTENT).status_code == 204
    assert is_known(client, upload)


def test_a_terminated_upload_is_gone_until_it_is_created_again(client: httpx.Client, upload: str) -> None:
    patch(client, upload, 0, CONTENT[:10])
    assert client.delete(upload, headers=TUS).status_code == 204
    assert client.head(upload, headers=TUS).status_code == 404
    assert code_of(patch(client, upload, 10, b"x")) == (404, "capture-unknown")
    create_upload(client, upload.split("/")[-2], "a.npy", CONTENT)
    assert offset_of(client, upload) == 0


def test_an_expired_upload_is_gone_and_its_bytes_too(
    client: httpx.Client, upload: str, world: World, tmp_path: Path
) -> None:
    world.now_s += 90
    assert patch(client, upload, 0, CONTENT[:10]).status_code == 204
    world.now_s += 90
    assert client.head(upload, headers=TUS).headers["upload-expires"] == "Sun, 09 Sep 2001 01:49:50 GMT"
    world.now_s += 11
    assert client.head(upload, headers=TUS).status_code == 410
    assert code_of(patch(client, upload, 10, b"x")) == (410, "upload-expired")
    first = upload.split("/")[-2]
    assert announce(client, CONTENTS)["id"] != first
    assert client.get(f"/v1/captures/{first}").json()["state"] == "expired"
    assert list((tmp_path / "partial").iterdir()) == []
    world.now_s += 201
    announce(client, {"capture.json": b"other"})
    assert client.get(f"/v1/captures/{first}").status_code == 404


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
    client: httpx.Client, upload: str, tmp_path: Path, *, with_checksum: bool
) -> None:
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
        wait_for_partial(tmp_path)
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
