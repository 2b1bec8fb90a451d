"""Masks by hand: over the API, in the preparation, and the effect of a changed mask on a finished job."""

from __future__ import annotations

import io
import json
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from services.api.app import create_app
from services.api.masks.images import picture_of
from services.core.errors import CaptureInputError
from services.core.masks import is_stale, mask_path
from services.core.records import JobSpec, MaskBit
from services.core.settings import ServerSettings
from services.core.stage import LocalContext
from services.pipeline.event_log import EventAddress
from services.pipeline.stage_task import StageTask
from services.pipeline.stages import run_stages
from services.preprocess import stage
from tests.support import toy_stages
from tests.support.live_server import serving
from tests.support.mouth import write_mouth
from tests.support.told_images import with_text

WIDTH, HEIGHT = 24, 18
Bits = NDArray[np.uint8]


class InThisProcess:
    """Runs the pipeline's stages in order without workers: a real preparation, then a toy fit and export."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.go.set()

    def __call__(self, spec: JobSpec, folder: Path, events: EventAddress) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("services.pipeline.stages._run_tasks", self._run)
            run_stages(
                spec,
                folder,
                ("prepare", "fit", "export"),
                events=events,
                doors=toy_stages.DOORS | {"prepare": "services.preprocess.stage:run"},
            )

    def _run(self, _processes: object, _count: int, tasks: list[StageTask], *_: object) -> None:
        assert self.go.wait(60)
        for task in tasks:
            task()


@pytest.fixture(scope="module")
def run() -> InThisProcess:
    return InThisProcess()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def client(data: Path, run: InThisProcess) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=data), run)) as client:
        yield client


@pytest.fixture(scope="module")
def mouth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mouth")
    write_mouth(folder, lights=2, sizes=((WIDTH, HEIGHT), (20, 16)), channels=("green",))
    return folder


def finished(client: httpx.Client, mouth: Path, **options: Any) -> str:
    """Submit a job and wait for its success; returns its id."""
    job: str = client.post("/v1/jobs", json={"capture": str(mouth), **options}).json()["id"]
    assert state_at_end(client, job) == "SUCCEEDED"
    return job


def state_at_end(client: httpx.Client, job: str) -> str:
    client.get(f"/v1/jobs/{job}/events")
    state: str = client.get(f"/v1/jobs/{job}").json()["state"]
    return state


def mask(*rows: slice) -> bytes:
    """PNG of a mask of some rows."""
    bits = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    for one in rows:
        bits[one] = 255
    return picture_of(bits)


def decoded(content: bytes) -> Bits:
    image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def stored(data: Path, job: str) -> NDArray[np.uint16]:
    return np.asarray(zarr.open_array(data / "jobs" / job / "prepared" / "prepared.zarr" / "valid", mode="r"))


def put(client: httpx.Client, job: str, place: str, content: bytes) -> httpx.Response:
    return client.put(f"/v1/jobs/{job}/masks/{place}", content=content, headers={"Content-Type": "image/png"})


def test_a_mask_is_prepared_again_and_nothing_of_before_is_left(client: httpx.Client, data: Path, mouth: Path) -> None:
    job = finished(client, mouth)
    folder = data / "jobs" / job
    before = stored(data, job)
    assert not (before & MaskBit.MANUAL).any()
    assert client.post(f"/v1/jobs/{job}/retry").json()["code"] == "job-state", "there is nothing to do again"
    one, every = mask(slice(6, 9)), mask(slice(11, 12))
    assert put(client, job, "c0/l1", one).status_code == 204
    assert put(client, job, "c0/all", every).status_code == 204
    assert client.get(f"/v1/jobs/{job}/masks/c0/l1").content == one
    listed = client.get(f"/v1/jobs/{job}/masks").json()
    assert ([(entry["camera"], entry["light"]) for entry in listed["masks"]], listed["is_stale"]) == (
        [("c0", "all"), ("c0", "l1")],
        True,
    )
    assert (stored(data, job) == before).all(), "until the retry, what is published holds"

    assert client.post(f"/v1/jobs/{job}/retry").status_code == 202
    assert state_at_end(client, job) == "SUCCEEDED"
    manual = stored(data, job) & MaskBit.MANUAL > 0
    expected = np.zeros_like(manual)
    expected[0, 1, 6:9, :WIDTH] = True
    expected[0, :, 11, :WIDTH] = True
    assert (manual == expected).all()
    assert (stored(data, job) & ~np.uint16(MaskBit.MANUAL) == before).all(), "no other reason has changed"
    assert (folder / "publications.txt").read_text().split() == ["fit", "export"] * 2
    assert client.get(f"/v1/jobs/{job}/masks").json()["is_stale"] is False
    shown = decoded(client.get(f"/v1/jobs/{job}/masks/c0/l1", params={"which": "prepared"}).content)
    assert (shown == stored(data, job)[0, 1, :HEIGHT, :WIDTH]).all()
    quality = json.loads((folder / "prepared" / "quality.json").read_text())["images"]
    assert [round(image["masked"].get("manual", 0), 3) > 0 for image in quality] == [True, True, False, False]

    # After both masks are deleted, the result is as before.
    for light in ("l1", "all"):
        assert client.delete(f"/v1/jobs/{job}/masks/c0/{light}").status_code == 204
    assert client.get(f"/v1/jobs/{job}/masks/c0/all").json()["code"] == "mask-unknown"
    assert client.post(f"/v1/jobs/{job}/retry").status_code == 202
    assert state_at_end(client, job) == "SUCCEEDED"
    assert (stored(data, job) == before).all()


def test_a_retry_that_fails_leaves_no_result_of_other_masks(client: httpx.Client, data: Path, mouth: Path) -> None:
    job = finished(client, mouth)
    put(client, job, "c0/all", mask(slice(None)))
    put(client, job, "c1/all", picture_of(np.full((16, 20), 1, dtype=np.uint8))).raise_for_status()
    assert client.post(f"/v1/jobs/{job}/retry").status_code == 202
    assert state_at_end(client, job) == "FAILED"
    assert "lacks a valid tooth pixel" in client.get(f"/v1/jobs/{job}").json()["failure"]["message"]
    left = [name for name in ("prepared", "fit", "asset", "report.html") if (data / "jobs" / job / name).exists()]
    assert left == []


def test_a_job_at_work_keeps_its_masks(client: httpx.Client, run: InThisProcess, mouth: Path) -> None:
    run.go.clear()
    try:
        job = client.post("/v1/jobs", json={"capture": str(mouth)}).json()["id"]
        while client.get(f"/v1/jobs/{job}").json()["state"] != "RUNNING":
            pass
        answer = put(client, job, "c0/l0", mask())
        assert (answer.status_code, answer.json()["code"]) == (409, "job-state")
    finally:
        run.go.set()
    assert state_at_end(client, job) == "SUCCEEDED"


@pytest.mark.parametrize(("place", "named"), [("c9/l0", "no camera c9"), ("c0/l9", "with light l9")])
def test_a_mask_of_nothing_is_refused(
    client: httpx.Client, data: Path, shared_job: str, place: str, named: str
) -> None:
    answer = put(client, shared_job, place, mask())
    assert (answer.status_code, answer.json()["code"]) == (404, "mask-unknown")
    assert named in answer.json()["detail"]
    assert not list((data / "jobs" / shared_job).glob("masks/*9*"))


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(
    rows_bytes: int, depth: int = 8, colour: int = 0, interlaced: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> bytes:
    """A PNG whose header and pixels may contradict each other."""
    header = struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, interlaced)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(bytes(rows_bytes)))
        + chunk(b"IEND", b"")
    )


WHOLE = HEIGHT * (1 + WIDTH)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"", "no PNG"),
        (b"\xff\xd8\xff\xe0" + bytes(100), "no PNG"),
        (png(WHOLE)[:20], "it is cut off"),
        (png(WHOLE)[:-20], "it is cut off"),
        (png(WHOLE)[:50] + b"x" + png(WHOLE)[51:], "damaged"),
        (png(WHOLE, size=(60_000, 60_000)), "60000 x 60000 pixels"),
        (png(WHOLE, colour=2), "not plain grey"),
        (png(WHOLE, depth=16), "not plain grey"),
        (png(WHOLE, interlaced=1), "not plain grey"),
        (png(100 * WHOLE), "more than its header declares"),
        (png(WHOLE - 1), "less than its header declares"),
    ],
)
def test_what_is_no_mask_is_refused(client: httpx.Client, content: bytes, named: str, shared_job: str) -> None:
    answer = put(client, shared_job, "c0/l0", content)
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-mask")
    assert named in answer.json()["detail"]
    assert f"send a grey PNG of {WIDTH} x {HEIGHT} pixels" in answer.json()["detail"]


@pytest.fixture(scope="module")
def shared_job(client: httpx.Client, mouth: Path) -> str:
    return finished(client, mouth)


@pytest.mark.parametrize("depth", [1, 8])
def test_masks_of_other_programs_are_taken(
    client: httpx.Client, mouth: Path, data: Path, depth: int, shared_job: str
) -> None:
    """Masks as Pillow writes them are accepted."""
    image = pytest.importorskip("PIL.Image")
    bits = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    bits[5:8, 3:21] = 255
    stream = io.BytesIO()
    image.fromarray(bits).convert("1" if depth == 1 else "L").save(stream, "png")
    assert put(client, shared_job, "c0/l0", stream.getvalue()).status_code == 204
    root = data / "jobs" / shared_job
    assert (decoded(client.get(f"/v1/jobs/{shared_job}/masks/c0/l0").content) > 0).tolist() == (bits > 0).tolist()
    stage.run(JobSpec(capture=mouth), LocalContext(root, attempt=1000 + depth))
    assert ((stored(data, shared_job)[0, 0, :HEIGHT, :WIDTH] & MaskBit.MANUAL > 0) == (bits > 0)).all()
    assert not is_stale(root)


def test_a_mask_is_kept_without_metadata(client: httpx.Client, shared_job: str) -> None:
    told = with_text(mask(slice(2, 4)), b"Author\0A name")
    assert put(client, shared_job, "c0/l1", told).status_code == 204
    assert client.get(f"/v1/jobs/{shared_job}/masks/c0/l1").content == mask(slice(2, 4))


def test_a_long_mask_is_refused_by_its_length(client: httpx.Client, shared_job: str) -> None:
    assert put(client, shared_job, "c0/l0", bytes(2**20 + 1)).json()["code"] == "body-too-large"


def test_files_that_are_no_masks_end_in_a_sentence(tmp_path: Path, mouth: Path) -> None:
    for name, content, named in (
        ("c0@l9.png", mask(), "of no camera and light"),
        ("c0@l1.png", mask()[:60], "24 x 18 pixels"),
        ("draft.txt", b"", "by its name"),
    ):
        root = tmp_path / name
        (root / "masks").mkdir(parents=True)
        (root / "masks" / name).write_bytes(content)
        with pytest.raises(CaptureInputError, match=named):
            stage.run(JobSpec(capture=mouth), LocalContext(root))


def test_odd_names_stay_in_the_folder(tmp_path: Path) -> None:
    for camera, light in (("..", ".."), ("/etc", "a@b"), (".hidden", "ü%2f")):
        assert mask_path(tmp_path, camera, light).resolve().parent == (tmp_path / "masks").resolve()
