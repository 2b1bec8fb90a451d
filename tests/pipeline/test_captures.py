"""Captures by upload over HTTP: announced, sent, committed, used by a job, deleted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.app import create_app
from services.core.records import JobSpec
from services.core.settings import ServerSettings, UploadLimits
from services.pipeline.event_log import EventAddress
from tests.support.live_server import serving
from tests.support.told_images import told_png
from tests.support.uploading import announce, contents_of, create_upload, entry, manifest_of, patch, send, write_capture

Serve = Callable[..., httpx.Client]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    with ExitStack() as stack:

        def start(run: Any = lambda *_: None, **limits: Any) -> httpx.Client:
            settings = ServerSettings(data=tmp_path / "data", uploads=UploadLimits(keep_free_bytes=0, **limits))
            return stack.enter_context(serving(create_app(settings, run)))

        yield start


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def shared(data: Path) -> Iterator[httpx.Client]:
    """A server that tests share; each uploads captures of its own."""
    settings = ServerSettings(data=data, uploads=UploadLimits(keep_free_bytes=0))
    with serving(create_app(settings, lambda *_: None)) as client:
        yield client


def send_missing(client: httpx.Client, capture: dict[str, Any], contents: dict[str, bytes]) -> None:
    for file in capture["files"]:
        if not file["is_known"]:
            assert send(client, capture["id"], file["path"], contents[file["path"]]).status_code == 204


def commit(client: httpx.Client, capture: dict[str, Any]) -> httpx.Response:
    return client.post(f"/v1/captures/{capture['id']}/commit")


def files_below(data: Path, *folders: str) -> set[Path]:
    return {path for folder in folders for path in (data / folder).rglob("*") if path.is_file()}


def test_a_capture_is_uploaded_committed_and_used_by_a_job(serve: Serve, tmp_path: Path) -> None:
    seen: dict[str, bytes] = {}

    def read_capture(spec: JobSpec, folder: Path, _events: EventAddress) -> None:
        assert spec.capture is not None
        assert (folder / "subject.txt").read_text() == "p-017\n"
        seen.update(contents_of(spec.capture))

    client = serve(read_capture)
    contents = contents_of(write_capture(tmp_path / "mine"))
    capture = announce(client, contents, subject="p-017")
    assert (capture["state"], capture["subject"]) == ("open", "p-017")
    assert [file["path"] for file in capture["files"] if not file["is_known"]] == list(contents)
    early = client.post("/v1/jobs", json={"capture": capture["path"]})
    assert (early.status_code, "commit it first" in early.json()["detail"]) == (422, True)

    send_missing(client, capture, contents)
    assert commit(client, capture).json()["state"] == "committed"
    assert commit(client, capture).status_code == 200
    job = client.post("/v1/jobs", json={"capture": capture["path"]})
    assert job.status_code == 201
    assert 'data: "SUCCEEDED"' in client.get(f"/v1/jobs/{job.json()['id']}/events").text
    assert seen == contents
    assert client.get(f"/v1/jobs/{job.json()['id']}").json()["spec"]["capture"] == capture["path"]
    used = client.delete(f"/v1/captures/{capture['id']}")
    assert (used.status_code, used.json()["code"]) == (409, "capture-state")


def test_published_files_are_read_only_and_share_their_content(
    shared: httpx.Client, data: Path, tmp_path: Path
) -> None:
    client = shared
    contents = contents_of(write_capture(tmp_path / "mine", seed=1))
    capture = announce(client, contents)
    send_missing(client, capture, contents)
    commit(client, capture)
    folder = data / capture["path"]
    assert {path.stat().st_mode & 0o777 for path in folder.rglob("*") if path.is_file()} == {0o400}
    assert {path.stat().st_nlink for path in folder.rglob("*") if path.is_file()} == {2}


def test_nothing_is_sent_twice(shared: httpx.Client, tmp_path: Path) -> None:
    client = shared
    contents = contents_of(write_capture(tmp_path / "mine", seed=2))
    first = announce(client, contents)
    assert announce(client, contents)["id"] == first["id"]
    send_missing(client, first, contents)
    commit(client, first)
    assert announce(client, dict(reversed(contents.items())))["id"] == first["id"]
    other = announce(client, contents | {"extra.json": b"{}"})
    assert other["id"] != first["id"]
    assert [file["path"] for file in other["files"] if not file["is_known"]] == ["extra.json"]
    assert other["missing_bytes"] == 2


def test_an_idempotency_key_belongs_to_one_manifest(shared: httpx.Client, tmp_path: Path) -> None:
    client = shared
    contents = contents_of(write_capture(tmp_path / "mine", seed=3))
    answers = [
        client.post("/v1/captures", json=manifest_of(contents), headers={"Idempotency-Key": "k"}) for _ in range(2)
    ]
    assert [answer.status_code for answer in answers] == [201, 200]
    other = client.post(
        "/v1/captures", json=manifest_of(contents | {"a.json": b"{}"}), headers={"Idempotency-Key": "k"}
    )
    assert (other.status_code, other.json()["code"]) == (409, "capture-state")


def test_a_commit_lists_exactly_what_is_missing_or_corrupt(shared: httpx.Client, data: Path, tmp_path: Path) -> None:
    client = shared
    contents = contents_of(write_capture(tmp_path / "mine", seed=4))
    capture = announce(client, contents)
    damaged = bytearray(contents["c0_l1.npy"])
    damaged[-1] ^= 1
    send(client, capture["id"], "capture.json", contents["capture.json"])
    refused = send(client, capture["id"], "c0_l1.npy", bytes(damaged))
    assert (refused.status_code, refused.json()["code"]) == (422, "upload-corrupt")
    assert "c0_l1.npy" in refused.json()["detail"]
    problem = commit(client, capture)
    assert (problem.status_code, problem.json()["code"]) == (409, "capture-incomplete")
    assert problem.headers["content-type"] == "application/problem+json"
    faults = {fault["path"]: fault["kind"] for fault in problem.json()["files"]}
    assert faults == {"c0_l0.npy": "missing", "c0_l1.npy": "corrupt", "teeth/11/outer.ply": "missing"}
    assert not (data / capture["path"]).exists()
    send_missing(client, client.get(f"/v1/captures/{capture['id']}").json(), contents)
    assert commit(client, capture).status_code == 200


def test_an_image_bomb_is_refused_by_name(shared: httpx.Client, tmp_path: Path) -> None:
    client = shared
    contents = contents_of(write_capture(tmp_path / "mine", seed=5))
    shape = (
        b"\x93NUMPY\x01\x00\x76\x00"
        + b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999, 99999, 3), }".ljust(117)
        + b"\n"
    )
    contents["c0_l1.npy"] = shape
    capture = announce(client, contents)
    send_missing(client, capture, contents)
    (fault,) = commit(client, capture).json()["files"]
    assert (fault["path"], fault["kind"]) == ("c0_l1.npy", "refused")
    assert "99999 x 99999 x 3" in fault["detail"]


def test_an_image_with_metadata_is_refused_by_name(shared: httpx.Client, tmp_path: Path) -> None:
    client = shared
    contents = contents_of(write_capture(tmp_path / "mine", seed=6)) | {"beauty.png": told_png()}
    capture = announce(client, contents)
    send_missing(client, capture, contents)
    (fault,) = commit(client, capture).json()["files"]
    assert (fault["path"], fault["kind"]) == ("beauty.png", "refused")
    assert fault["detail"].startswith("Image beauty.png carries metadata (eXIf, iTXt, tEXt)")


def test_a_deleted_capture_leaves_nothing_that_no_other_has(serve: Serve, tmp_path: Path) -> None:
    client = serve()
    contents = contents_of(write_capture(tmp_path / "mine"))
    first, second = announce(client, contents), announce(client, contents | {"extra.json": b"{}"})
    send_missing(client, first, contents)
    commit(client, first)
    patch(client, create_upload(client, second["id"], "extra.json", b"{}"), 0, b"{")
    held = files_below(tmp_path / "data", "blobs")
    assert client.delete(f"/v1/captures/{first['id']}").status_code == 204
    assert not (tmp_path / "data" / first["path"]).exists()
    assert files_below(tmp_path / "data", "blobs") == held != set()
    assert client.delete(f"/v1/captures/{second['id']}").status_code == 204
    assert files_below(tmp_path / "data", "blobs", "partial", "captures") == set()
    assert client.get("/v1/captures").json()["captures"] == []
    assert client.get(f"/v1/captures/{first['id']}").status_code == 404


def test_captures_are_listed_in_pages(serve: Serve, tmp_path: Path) -> None:
    client = serve()
    ids = [announce(client, {"capture.json": f"{number}".encode()})["id"] for number in range(5)]
    seen, before = [], None
    while True:
        page = client.get("/v1/captures", params={"limit": 2} | ({"before": before} if before else {})).json()
        seen += [capture["id"] for capture in page["captures"]]
        before = page["next_before"]
        if before is None:
            break
    assert seen == ids[::-1]


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        ({"most_files": 3}, "4 files and 3 are allowed"),
        ({"largest_capture_bytes": 600}, "600 are allowed"),
        ({"largest_file_bytes": 300}, "'c0_l0.npy' has 320 bytes"),
        ({"largest_text_bytes": 20}, "'capture.json'"),
    ],
)
def test_limits_are_named_before_anything_is_sent(
    serve: Serve, tmp_path: Path, limits: dict[str, int], named: str
) -> None:
    answer = serve(**limits).post("/v1/captures", json=manifest_of(contents_of(write_capture(tmp_path / "mine"))))
    assert (answer.status_code, answer.json()["code"]) == (413, "upload-too-large")
    assert named in answer.json()["detail"]


def test_a_capture_that_the_disk_cannot_hold_is_refused(serve: Serve) -> None:
    vast = {"path": "a.npy", "bytes": 2**50, "sha256": "0" * 64}
    answer = serve(largest_file_bytes=2**51, largest_capture_bytes=2**51).post(
        "/v1/captures", json={"files": [entry("capture.json", b"{}"), vast]}
    )
    assert (answer.status_code, answer.json()["code"]) == (507, "disk-full")


@pytest.mark.parametrize(
    "path", ["/v1/captures/none", "/v1/captures/a%00b", "/v1/uploads/none/0", "/v1/captures/%27--/commit"]
)
def test_what_is_not_there_is_a_problem_document(shared: httpx.Client, path: str) -> None:
    client = shared
    method = client.post if path.endswith("commit") else client.head if "uploads" in path else client.get
    answer = method(path, headers={"Tus-Resumable": "1.0.0"})
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_job_cannot_name_an_unknown_capture(shared: httpx.Client) -> None:
    answer = shared.post("/v1/jobs", json={"capture": "captures/0123456789abcdef"})
    assert (answer.status_code, "There is no capture" in answer.json()["detail"]) == (422, True)
