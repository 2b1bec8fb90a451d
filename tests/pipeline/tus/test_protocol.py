"""Requests and answers of the tus protocol: options, parts, offsets, versions, checksums, metadata."""

from __future__ import annotations

import httpx
import pytest

from services.core.settings import UploadLimits
from tests.support.tus_world import CONTENT, code_of, is_known
from tests.support.uploading import TUS, checksum, create_upload, offset_of, patch


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
