"""The bytes that an upload accepts, and the time after which it expires."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from tests.support.tus_world import CONTENT, CONTENTS, World, code_of, is_known
from tests.support.uploading import TUS, announce, create_upload, offset_of, patch


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
