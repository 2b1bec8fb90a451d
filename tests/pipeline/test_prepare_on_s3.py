"""A preparation with its arrays on an S3 server: the same pixels, the number of requests, kills, losses, refusals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.core.errors import CorruptStoreError, PlatformError, StoreError
from services.core.files import object_store
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.core.store import StoredArray, open_stage, require_intact, withdraw
from services.fit.measurements.levels import LevelReader
from services.fit.measurements.observations import read_channel, read_observations
from services.preprocess.stage import run
from services.preprocess.tasks import attempt_files
from tests.support.folder_captures import prepare, write_folder, write_tree
from tests.support.s3_server import BUCKET, S3Server, environment, s3_server, use

URL = f"s3://{BUCKET}/lab/one"
ARRAYS = ("radiance", "variance", "valid", "surface")
IMAGES = 4


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    with s3_server() as server:
        use(monkeypatch, server.endpoint)
        yield server


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    (tmp_path / "capture").mkdir()
    write_folder(tmp_path / "capture")
    return tmp_path / "capture"


def pixels(root: Path) -> dict[str, Any]:
    return {name: StoredArray(root / "prepared" / "prepared.zarr" / name)[:] for name in ARRAYS}


def assert_same(root: Path, other: Path) -> None:
    there = pixels(other)
    for name, values in pixels(root).items():
        np.testing.assert_array_equal(values, there[name], strict=True)


def assert_fit_reads_the_same(capture: Path, root: Path, other: Path) -> None:
    spec = JobSpec(capture=capture, pixel_step=2)
    views, there = (read_channel(read_observations(one, spec), "blue", spec) for one in (root, other))
    for view, again in zip(views, there, strict=True):
        np.testing.assert_array_equal(view.reference, again.reference, strict=True)
        np.testing.assert_array_equal(view.variance, again.variance, strict=True)


def pointer(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / "prepared" / "prepared.zarr").read_text()))


def test_same_pixels_by_one_put_a_shard(server: S3Server, capture: Path, tmp_path: Path) -> None:
    here, there = prepare(capture, tmp_path / "here"), prepare(capture, tmp_path / "there", store=URL)
    assert here == there
    # Three arrays have one object per image, one array has one per camera, and each array and their group have a
    # description.
    shards, descriptions = 3 * IMAGES + 2, len(ARRAYS) + 1
    assert server.count("PUT", found=True) == shards + descriptions == len(server.objects())
    assert not [one for one in (tmp_path / "there" / "prepared").rglob("c") if one.is_dir()]
    assert_same(tmp_path / "here", tmp_path / "there")
    assert_fit_reads_the_same(capture, tmp_path / "here", tmp_path / "there")
    told = pointer(tmp_path / "there")
    assert {f"lab/one/{told['url'].removeprefix(f'{URL}/')}/{name}" for name in told["objects"]} == set(
        server.objects()
    )
    assert open_stage(tmp_path / "there", "prepared", PreparedManifest)[1] == there
    # The URL alone is kept: no file of the job holds a key or the endpoint.
    secrets = [value.encode() for name, value in environment(server.endpoint).items() if name != "AWS_REGION"]
    for path in (one for one in (tmp_path / "there").rglob("*") if one.is_file()):
        assert not [secret for secret in secrets if secret in path.read_bytes()], path


def test_shadows_are_flagged_there_too(server: S3Server, capture: Path, tmp_path: Path) -> None:
    for root, options in ((tmp_path / "here", {}), (tmp_path / "there", {"store": URL})):
        prepare(capture, root, shadows=True, **options)
    assert_same(tmp_path / "here", tmp_path / "there")


def of_size(root: Path, size: tuple[int, int]) -> Path:
    """Write a capture of one camera of this image size, with the same tooth of 90 pixels across at its centre."""
    root.mkdir()
    tree = write_folder(root)
    width, height = size
    K = [[11_000, 0, width / 2], [0, 11_000, height / 2], [0, 0, 1]]
    tree["cameras"] = [{**tree["cameras"][0], "size": size, "K": K}]
    tree["images"] = [one for one in tree["images"] if one["camera"] == tree["cameras"][0]["name"]]
    noise = np.random.default_rng(1)
    for one in tree["images"]:
        np.save(root / one["file"], noise.uniform(0.5, 1, (height, width, 2)).astype(np.float32))
    write_tree(root, tree)
    return root


def test_reading_a_tooth_at_a_level_asks_as_often_of_any_size(server: S3Server, tmp_path: Path) -> None:
    """In an image four times as large, reading the tooth needs the same number of requests and nearly as many bytes."""
    asked = []
    # The sizes are multiples of the chunks' 512 px, so that the tooth lies across four chunks in both.
    for edge in (1024, 2048):
        root = tmp_path / f"{edge}"
        prepare(of_size(tmp_path / f"capture-{edge}", (edge, edge)), root, store=URL)
        folder, manifest = open_stage(root, "prepared", PreparedManifest)
        server.asked.clear()
        level = LevelReader(folder / "prepared.zarr", 0, step=4)
        for light in range(2):
            radiance, _ = level.image(0, light, manifest.cameras[0])
            assert radiance.shape == (edge // 4, edge // 4)
            level.bits(0, light, manifest.cameras[0])
        numbers = sum(one.bytes for one in server.asked if "valid" not in one.key)
        asked.append((server.count("GET"), numbers, sum(one.bytes for one in server.asked) - numbers))
    small, large = asked
    # There is one request for the description of each of three arrays, then one for each array and light.
    assert small[0] == large[0] == 3 + 3 * 2
    # The larger image has 16 bytes of index more per chunk, and its noise compresses differently.
    assert large[1] <= 1.02 * small[1]
    # The mask is one chunk. It is constant outside the tooth, and LZ4 compresses that to a 255th at best.
    assert large[2] <= 2 * 2 * 2048**2 / 200


def begin(capture: Path, root: Path, attempt: int) -> subprocess.Popen[bytes]:
    """Start an attempt in a process of its own."""
    code = (
        "import sys; from pathlib import Path; from services.core.records import JobSpec;"
        "from services.core.stage import LocalContext; from services.preprocess.stage import run;"
        "run(JobSpec(capture=Path(sys.argv[1]), store=sys.argv[4]), LocalContext(Path(sys.argv[2]), int(sys.argv[3])))"
    )
    command = [sys.executable, "-c", code, str(capture), str(root), str(attempt), URL]
    return subprocess.Popen(command)


@pytest.mark.dear("A preparation is killed twice and goes on.")
def test_killed_while_it_writes(server: S3Server, capture: Path, tmp_path: Path) -> None:
    """Attempts are killed by SIGKILL while they send a shard, before and after it is stored, until one ends. The store
    is then that of an undisturbed attempt.
    """
    prepare(capture, tmp_path / "whole", store=URL)
    whole = {name.partition("prepared.zarr/")[2]: content for name, content in server.objects().items()}
    withdraw(tmp_path / "whole", "prepared")
    assert not server.objects()
    kills, root = 0, tmp_path / "killed"
    for attempt in range(1, 10):
        shards = 0
        child = begin(capture, root, attempt)

        def strike(
            method: str, path: str, child: subprocess.Popen[bytes] = child, attempt: int = attempt
        ) -> str | None:
            nonlocal shards
            if method != "PUT" or "/c/" not in path:
                return None
            shards += 1
            # In mid-image: two arrays of surfaces, one whole image, and two of another image's three arrays.
            if shards < 7:
                return None
            os.kill(child.pid, signal.SIGKILL)
            return None if attempt % 2 else "500 Internal Server Error"

        server.before = strike
        if child.wait(timeout=120) == 0:
            break
        assert child.returncode == -signal.SIGKILL
        kills += 1
    assert kills >= 2
    found = {name.partition("prepared.zarr/")[2]: content for name, content in server.objects().items()}
    assert found == whole
    assert len(pointer(root)["objects"]) == len(whole)
    require_intact(root, "prepared")


def test_images_that_a_server_lost_meanwhile_are_made_again(
    server: S3Server, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_off(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(attempt_files.AttemptFiles, "seal", cut_off)
        with pytest.raises(KeyboardInterrupt):
            prepare(capture, tmp_path / "job", store=URL)
    lost = next(name for name in server.objects() if "radiance/c/1/0" in name)
    server.remove(lost)
    server.asked.clear()
    run(JobSpec(capture=capture, store=URL), LocalContext(tmp_path / "job", 2))
    # Only this image is written again: radiance, variance and valid.
    assert server.count("PUT") == 3
    prepare(capture, tmp_path / "here")
    assert_same(tmp_path / "here", tmp_path / "job")


def test_what_was_published_and_is_gone_is_told_and_made_anew(server: S3Server, capture: Path, tmp_path: Path) -> None:
    prepare(capture, tmp_path, store=URL)
    shard = next(name for name in server.objects() if "variance/c/0/1" in name)
    size = len(server.objects()[shard])
    for happens in ("is missing", "is not the object"):
        server.remove(shard) if happens == "is missing" else server.put(shard, b"x" * size)
        with pytest.raises(
            CorruptStoreError, match=rf"s3://.*/variance/c/0/1/\S+ {happens}.*; restore it, or retry the job.*\.$"
        ):
            open_stage(tmp_path, "prepared", PreparedManifest)
    withdraw(tmp_path, "prepared")
    assert not server.objects()
    run(JobSpec(capture=capture, store=URL), LocalContext(tmp_path, 2))
    require_intact(tmp_path, "prepared")


@pytest.mark.parametrize(
    ("status", "sentence"),
    [
        ("403 Forbidden", "does not permit this; let these credentials"),
        ("401 Unauthorized", "takes no request without valid credentials; set AWS_ACCESS_KEY_ID"),
        ("503 Service Unavailable", "does not answer; check AWS_ENDPOINT_URL"),
    ],
)
def test_a_server_that_refuses(
    server: S3Server, capture: Path, tmp_path: Path, status: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_store, "RETRIES", 1)
    server.before = lambda *_: status
    with pytest.raises(StoreError, match=rf"^The S3 server of {URL}/\S+ {sentence}.*\.$"):
        prepare(capture, tmp_path, store=URL)


def test_a_server_that_refuses_in_mid_work(
    server: S3Server, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server refuses after some writes; afterwards the job continues."""
    monkeypatch.setattr(object_store, "RETRIES", 1)
    status, sentence = "503 Service Unavailable", "does not answer; check AWS_ENDPOINT_URL"
    server.before = lambda method, path: status if method == "PUT" and "radiance/c/1/" in path else None
    with pytest.raises(StoreError, match=sentence):
        prepare(capture, tmp_path, store=URL)
    server.before = lambda *_: None
    server.asked.clear()
    run(JobSpec(capture=capture, store=URL), LocalContext(tmp_path, 2))
    assert 0 < server.count("PUT") < 3 * IMAGES
    server.before = lambda *_: status
    with pytest.raises(StoreError, match=sentence):
        open_stage(tmp_path, "prepared", PreparedManifest)


def test_a_bucket_that_is_not_there(server: S3Server, capture: Path, tmp_path: Path) -> None:
    with pytest.raises(
        StoreError,
        match=r"s3://none-such/x/\S+ has no bucket of that name; create it, or correct the option 'store'\.$",
    ):
        prepare(capture, tmp_path, store="s3://none-such/x")


def test_an_endpoint_where_nobody_listens(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "RETRIES", 1)
    use(monkeypatch, "http://127.0.0.1:9")
    with pytest.raises(
        StoreError, match=r"does not answer; check AWS_ENDPOINT_URL and the network, then retry the job\.$"
    ):
        prepare(capture, tmp_path, store=URL)


@pytest.mark.parametrize("lacks", [("AWS_ACCESS_KEY_ID",), ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")])
def test_without_credentials(
    server: S3Server, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacks: tuple[str, ...]
) -> None:
    """Without credentials the library queries the metadata service of Amazon's machines, which does not exist here."""
    for name in lacks:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(object_store, "RETRIES", 0)
    with pytest.raises(StoreError, match=r"takes no request without valid credentials; set AWS_ACCESS_KEY_ID"):
        prepare(capture, tmp_path, store=URL)


def test_without_the_library(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(PlatformError, match=r"obstore is not installed; install dentine\[s3\] on this machine\.$"):
        prepare(capture, tmp_path, store=URL)


@pytest.mark.parametrize(
    "url",
    [
        "http://host/teeth",
        "s3://user:key@teeth/x",
        "s3://host:9000/teeth",
        "s3://teeth/../other",
        "s3://teeth/x/",
        "s3://teeth/x?versionId=1",
        "s3://T",
        "/data",
    ],
)
def test_what_is_no_store(url: str) -> None:
    with pytest.raises(ValueError, match=r"give s3://BUCKET/PREFIX"):
        JobSpec(capture=Path("capture"), store=url)
