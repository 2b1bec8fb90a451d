"""SIGKILL of the server in mid-request and of the client in mid-file, and deaths of the server during a commit and
during a deletion.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import numpy as np
import pytest

from services.api.captures.captures import Captures
from services.client.capture_records import UploadManifest
from services.core.settings import UploadLimits
from tests.support.command_line import dentine
from tests.support.live_server import toy_server
from tests.support.uploading import (
    announce,
    contents_of,
    create_upload,
    manifest_of,
    offset_of,
    patch,
    upgraded,
    write_capture,
)

MIB = 2**20
KILLS = 3


class Death(BaseException):
    """Exception that stands for the end of the process, because no handler of ``Exception`` catches it."""


def upload_by_command(folder: Path, server: str) -> dict[str, object]:
    answer = dentine("upload", str(folder), "--server", server, "--json")
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout)


def send_until_killed(
    server: httpx.Client, process: subprocess.Popen[str], upload: str, offset: int, content: bytes
) -> None:
    """Send some bytes of a request that never ends, then kill the server, which has read all but the last of them."""
    is_sent = threading.Event()

    def body() -> Iterator[bytes]:
        for start in range(0, len(content), 2**16):
            yield content[start : start + 2**16]
        is_sent.set()
        process.wait()

    def request() -> None:
        with (
            suppress(httpx.TransportError),
            httpx.Client(base_url=server.base_url, trust_env=False, timeout=60) as client,
        ):
            patch(client, upload, offset, body())

    thread = threading.Thread(target=request)
    thread.start()
    assert is_sent.wait(60)
    process.kill()
    process.wait()
    thread.join()


@pytest.mark.dear("Servers are started, killed and started again.")
def test_a_server_killed_in_mid_request_loses_at_most_what_it_had_not_acknowledged(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    folder = write_capture(tmp_path / "mine")
    np.save(folder / "large.npy", rng.integers(0, 255, 30 * MIB, dtype=np.uint8))
    contents = contents_of(folder)
    large, acknowledged = contents["large.npy"], 0
    capture = upload = ""
    for _ in range(KILLS):
        with toy_server(tmp_path / "data") as (server, process):
            found = announce(server, contents)
            assert found["id"] == (capture or found["id"])
            capture, upload = found["id"], create_upload(server, found["id"], "large.npy", large)
            assert offset_of(server, upload) == acknowledged
            some = int(rng.integers(1, 3 * MIB))
            assert patch(server, upload, acknowledged, large[acknowledged : acknowledged + some]).status_code == 204
            acknowledged += some
            more = int(rng.integers(1, 6 * MIB))
            send_until_killed(server, process, upload, acknowledged, large[acknowledged : acknowledged + more])
    with toy_server(tmp_path / "data") as (server, _):
        assert offset_of(server, upload) == acknowledged
        uploaded = upload_by_command(folder, str(server.base_url))
    assert uploaded["id"] == capture
    assert uploaded["sent_bytes"] == sum(map(len, contents.values())) - acknowledged
    assert contents_of(tmp_path / "data" / "captures" / capture) == contents


@pytest.mark.dear("A client is killed and another one started.")
def test_a_killed_client_is_continued_by_another(tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "mine")
    np.save(folder / "large.npy", np.random.default_rng(6).integers(0, 255, 60 * MIB, dtype=np.uint8))
    contents = contents_of(folder)
    with toy_server(tmp_path / "data") as (server, _):
        command = [sys.executable, "-m", "services", "upload", str(folder), "--server", str(server.base_url)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as client:
            while not (captures := server.get("/v1/captures").json()["captures"]):
                time.sleep(0.02)
            address = f"/v1/captures/{captures[0]['id']}"
            while server.get(address).json()["missing_bytes"] > 50 * MIB:
                time.sleep(0.02)
            client.kill()
        missing = server.get(address).json()["missing_bytes"]
        assert 0 < missing <= 50 * MIB
        uploaded = upload_by_command(folder, str(server.base_url))
    assert uploaded["id"] == captures[0]["id"]
    sent = uploaded["sent_bytes"]
    assert isinstance(sent, int)
    assert sent <= missing
    assert contents_of(tmp_path / "data" / str(uploaded["path"])) == contents


@contextmanager
def captures_of(data: Path) -> Iterator[Captures]:
    """The captures of a data folder, as a starting server opens them."""
    engine = upgraded(data / "db.sqlite")
    yield Captures(engine, data, UploadLimits(keep_free_bytes=0))
    engine.dispose()


def receive_all(captures: Captures, contents: dict[str, bytes], sent: dict[str, bytes]) -> str:
    """Create a capture of some contents and store the bytes sent for it, without HTTP; returns its id."""
    capture = captures.create(UploadManifest.model_validate(manifest_of(contents))).capture
    for number, file in enumerate(capture.files):
        upload = captures.uploads.create(capture.id, file.path, file.bytes)
        if not file.is_known:
            with captures.uploads.open_partial(upload) as partial:
                partial.write(sent[file.path])
                partial.sync()
            captures.uploads.record(upload, file.bytes)
            captures.uploads.finish(captures.uploads.find(capture.id, number).row)
    return capture.id


def die(*_: object, **__: object) -> None:
    raise Death


@pytest.mark.parametrize(
    "step",
    [
        "services.api.captures.captures.sync_folders",
        "pathlib.Path.rename",
        "services.api.tables.captures.CaptureTable.change_state",
    ],
)
def test_a_commit_that_died_anywhere_is_invisible_or_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    contents = contents_of(write_capture(tmp_path / "mine"))
    with captures_of(tmp_path) as captures:
        capture = receive_all(captures, contents, contents)
        with monkeypatch.context() as dying:
            dying.setattr(step, die)
            with pytest.raises(Death):
                captures.commit(capture)
    final = tmp_path / "captures" / capture
    assert not final.exists() or contents_of(final) == contents
    with captures_of(tmp_path) as captures:
        assert captures.get(capture).state == "open"
        assert captures.commit(capture) == []
        assert captures.get(capture).state == "committed"
    assert contents_of(final) == contents
    assert [path.name for path in (tmp_path / "captures").iterdir()] == [capture]


@pytest.mark.parametrize(
    "step",
    [
        "shutil.rmtree",
        "services.api.captures.blobs.Blobs.remove",
        "services.api.tables.captures.CaptureTable.delete_files",
    ],
)
def test_a_deletion_that_died_anywhere_is_completed_by_the_next_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    contents = contents_of(write_capture(tmp_path / "mine"))
    with captures_of(tmp_path) as captures:
        capture = receive_all(captures, contents, contents)
        captures.commit(capture)
        with monkeypatch.context() as dying:
            dying.setattr(step, die)
            with pytest.raises(Death):
                captures.delete(capture)
    with captures_of(tmp_path) as captures:
        assert captures.get(capture).state == "expired"
        captures.sweep()
    left = [
        path for folder in ("blobs", "captures", "partial") for path in (tmp_path / folder).rglob("*") if path.is_file()
    ]
    assert left == []


def test_what_a_dead_server_received_whole_but_never_verified_is_verified_at_the_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    contents = contents_of(write_capture(tmp_path / "mine"))
    damaged = contents | {"c0_l1.npy": contents["c0_l1.npy"][:-1] + b"\0"}
    with captures_of(tmp_path) as captures:
        capture = captures.create(UploadManifest.model_validate(manifest_of(contents))).capture.id
        with monkeypatch.context() as dead:
            dead.setattr("services.api.captures.uploads.Uploads.finish", lambda *_: None)
            receive_all(captures, contents, damaged)
    with captures_of(tmp_path) as captures:
        assert captures.get(capture).missing_bytes == 0
        assert not any(file.is_known for file in captures.get(capture).files)
        assert [(fault.path, fault.kind) for fault in captures.commit(capture)] == [("c0_l1.npy", "corrupt")]
        assert [file.path for file in captures.get(capture).files if not file.is_known] == ["c0_l1.npy"]
        receive_all(captures, contents, contents)
        assert captures.commit(capture) == []
    assert contents_of(tmp_path / "captures" / capture) == contents
