"""The client and the command line upload a folder over broken connections, and send no files that the server already
has.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from services.api.app import create_app
from services.client.client import Client
from services.client.errors import CorruptUploadError, IncompleteCaptureError, TooLargeError, UploadError
from services.client.uploader import CHUNK_BYTES, Uploader, UploadProgress
from services.core.errors import CaptureInputError, DiskFullError, PlatformError
from services.core.settings import ServerSettings, UploadLimits
from tests.support.command_line import dentine
from tests.support.cutting_proxy import cutting
from tests.support.live_server import serving
from tests.support.told_images import told_png
from tests.support.uploading import contents_of, write_capture


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def server(data: Path) -> Iterator[httpx.Client]:
    limits = UploadLimits(keep_free_bytes=0, largest_file_bytes=64 * 2**20, largest_image_bytes=64 * 2**20)
    with serving(create_app(ServerSettings(data=data, uploads=limits), lambda *_: None)) as client:
        yield client


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small capture with one array of several chunks, and files that are not part of a capture."""
    folder = write_capture(tmp_path / "mine")
    np.save(folder / "large.npy", np.random.default_rng(1).integers(0, 255, (20, 2**20), dtype=np.uint8))
    (folder / "notes.txt").write_text("notes")
    (folder / ".hidden").write_text("hidden")
    (folder / "link.npy").symlink_to(folder / "large.npy")
    return folder


def wanted(folder: Path) -> dict[str, bytes]:
    return {
        path: content
        for path, content in contents_of(folder).items()
        if path not in {"notes.txt", ".hidden", "link.npy"}
    }


def test_a_folder_is_uploaded_once(server: httpx.Client, folder: Path, data: Path) -> None:
    told: list[UploadProgress] = []
    with Client(str(server.base_url)) as client:
        first = client.upload(folder, told.append, "p-1")
        second = client.upload(folder, subject="p-1")
    total = sum(map(len, wanted(folder).values()))
    assert contents_of(data / first.path) == wanted(folder)
    assert (first.bytes, first.sent_bytes, first.left_out) == (total, total, (".hidden", "link.npy", "notes.txt"))
    assert (second.id, second.sent_bytes) == (first.id, 0)
    for phase in ("hashing", "sending"):
        done = [progress.done_bytes for progress in told if progress.phase == phase]
        assert done == sorted(done)
        assert done[-1] == total


def test_an_upload_survives_cuts_of_the_connection(server: httpx.Client, folder: Path, data: Path) -> None:
    cuts = np.random.default_rng(2).integers(1, 20 * 2**20, 6).tolist()
    assert server.base_url.port is not None
    with cutting(server.base_url.port, cuts) as proxy, Client(proxy.address) as client:
        uploaded = client.upload(folder)
        assert proxy.cut_count == len(cuts)
    assert contents_of(data / uploaded.path) == wanted(folder)
    assert uploaded.sent_bytes <= uploaded.bytes + len(cuts) * CHUNK_BYTES


def test_a_server_that_never_comes_back_is_a_sentence(server: httpx.Client, folder: Path) -> None:
    assert server.base_url.port is not None
    cuts = [3 * 2**20 + number for number in range(1000)]
    told = "repeat this command, what was sent is kept"
    with (
        cutting(server.base_url.port, cuts) as proxy,
        Client(proxy.address) as client,
        pytest.raises(PlatformError, match=told),
    ):
        client.run(Uploader(proxy.address, patience_s=1.0).upload(folder))


def test_a_folder_that_is_no_capture_is_refused_before_anything_is_sent(server: httpx.Client, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with Client(str(server.base_url)) as client:
        with pytest.raises(CaptureInputError, match="not a folder"):
            client.upload(tmp_path / "nowhere")
        with pytest.raises(UploadError, match="neither"):
            client.upload(tmp_path / "other")
        (tmp_path / "other" / "capture.json").touch()
        with pytest.raises(CaptureInputError, match="empty"):
            client.upload(tmp_path / "other")
    assert server.get("/v1/captures").json()["captures"] == []


def test_an_image_with_metadata_never_leaves_this_machine(server: httpx.Client, folder: Path) -> None:
    (folder / "beauty.png").write_bytes(told_png())
    with (
        Client(str(server.base_url)) as client,
        pytest.raises(UploadError, match=r"^Image beauty\.png carries metadata \(eXIf"),
    ):
        client.upload(folder)
    assert server.get("/v1/captures").json()["captures"] == []


def test_refusals_of_the_server_keep_their_kind(server: httpx.Client, folder: Path) -> None:
    with Client(str(server.base_url)) as client:
        np.save(folder / "vast.npy", np.zeros(70 * 2**20, dtype=np.uint8))
        with pytest.raises(TooLargeError, match=r"vast\.npy"):
            client.upload(folder)
        (folder / "vast.npy").unlink()
        (folder / "c0_l1.npy").unlink()
        with pytest.raises(IncompleteCaptureError, match=r"c0_l1\.npy"):
            client.upload(folder)


def test_a_file_that_changes_meanwhile_is_refused_by_name(server: httpx.Client, folder: Path) -> None:
    def change(progress: UploadProgress) -> None:
        if progress.phase == "sending" and progress.path == "large.npy":
            with (folder / "large.npy").open("r+b") as stream:
                stream.seek(-1, 2)
                stream.write(b"\xff")

    with Client(str(server.base_url)) as client, pytest.raises(CorruptUploadError, match=r"large\.npy"):
        client.upload(folder, change)


def test_an_error_of_the_tree_is_found_by_its_code() -> None:
    from services.client.flows import error_in

    answer = httpx.Response(507, json={"detail": "The disk is full.", "code": "disk-full"})
    assert type(error_in(answer)) is DiskFullError
    assert "is it a dentine server" in error_in(httpx.Response(500, text="x")).message


def test_the_command_uploads_and_a_job_is_submitted_with_it(server: httpx.Client, folder: Path, tmp_path: Path) -> None:
    address = str(server.base_url)
    first = dentine("upload", str(folder), "--server", address, "--subject", "p-2", "--json")
    assert first.returncode == 0, first.stderr
    uploaded = json.loads(first.stdout)
    assert "sending 100 %" in first.stderr
    assert "Left out, as no part of a capture: .hidden, link.npy, notes.txt." in first.stderr
    assert dentine("upload", str(folder), "--server", address, "--subject", "p-2").stdout == f"{uploaded['path']}\n"
    job = tmp_path / "job.toml"
    job.write_text(f'capture = "{folder}"\n')
    submitted = dentine("submit", str(job), "--upload", "--server", address, "--json")
    assert submitted.returncode == 0, submitted.stderr
    assert json.loads(submitted.stdout)["spec"]["capture"].startswith("captures/")
    named = dentine("upload", str(folder), "--server", address, "--subject", "Jane Doe")
    assert (named.returncode, "'Jane Doe' is no label" in named.stderr) == (2, True)
    assert dentine("upload", str(tmp_path / "nowhere"), "--server", address).returncode == 2
    assert dentine("upload", str(folder), "--server", "http://127.0.0.1:9").returncode == 4
