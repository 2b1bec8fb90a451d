"""Descriptions inside uploads are read in processes with bounded memory and time, so that no file exhausts those of the
server.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest

from services.api.app import create_app
from services.api.captures import reading
from services.api.captures.contents import content_fault
from services.api.captures.descriptions import MAX_DESCRIPTION_BYTES
from services.api.captures.reading import SubprocessReader
from services.core.errors import CaptureInputError
from services.core.settings import ServerSettings, UploadLimits
from tests.support.live_server import serving
from tests.support.uploading import announce, contents_of, send, write_capture

LIMITS = UploadLimits(keep_free_bytes=0)
FILES, FILE_BYTES = 10, 2 * 10**9
"""Number and size of the files of a raw capture of 20 GB, which are sparse and take no disk space."""


@pytest.fixture(scope="module")
def apart() -> Iterator[SubprocessReader]:
    reader = SubprocessReader()
    yield reader
    reader.close()


def faults(reader: SubprocessReader, *files: tuple[Path, str], names: frozenset[str] = frozenset()) -> dict[str, str]:
    return dict(reader.content_faults(files, LIMITS, names))


def children() -> list[psutil.Process]:
    return [one for one in psutil.Process().children() if "services.api.captures.reading_process" in one.cmdline()]


def test_it_says_what_would_be_said_in_this_process(apart: SubprocessReader, tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "capture")
    (folder / "c0_l1.npy").write_bytes(b"no array")
    (folder / "broken.json").write_text("[")
    names = frozenset(contents_of(folder)) - {"c0_l0.npy"}
    here = {
        name: content_fault(folder / name, name, LIMITS, names) for name in ("capture.json", "c0_l0.npy", "c0_l1.npy")
    }
    assert faults(apart, *((folder / name, name) for name in here), names=names) == {
        name: told for name, told in here.items() if told
    }
    assert len(faults(apart, (folder / "c0_l1.npy", "c0_l1.npy"))) == 1
    assert [one.name for one in apart.describe(folder).calibration.lights] == ["l0", "l1"]
    with pytest.raises(CaptureInputError, match="holds neither"):
        apart.describe(tmp_path)


@pytest.mark.attack("uploads", "a description that takes memory")
def test_a_description_that_takes_memory_costs_a_process_and_a_sentence(
    apart: SubprocessReader, tmp_path: Path
) -> None:
    folder = write_capture(tmp_path / "capture")
    whole = (folder / "capture.json").read_text()
    costly, large = tmp_path / "costly.json", tmp_path / "large.json"
    costly.write_text(whole[:-1] + ', "more": [' + "[]," * (MAX_DESCRIPTION_BYTES // 3 - 1000) + "[]]}")
    large.write_text(whole + " " * MAX_DESCRIPTION_BYTES)
    (told,) = faults(apart, (costly, "capture.json"), (folder / "c0_l0.npy", "c0_l0.npy")).values()
    assert told.startswith("capture.json cannot be read within 96 MiB of memory")
    assert told.count(".") == 2  # the full stop of one sentence, and the dot in the file's name
    (told,) = faults(apart, (large, "capture.json")).values()
    assert f"{MAX_DESCRIPTION_BYTES} are allowed" in told
    (folder / "capture.json").write_bytes(large.read_bytes())
    with pytest.raises(CaptureInputError, match=f"{MAX_DESCRIPTION_BYTES} are allowed"):
        apart.describe(folder)
    assert faults(apart, (folder / "c0_l0.npy", "c0_l0.npy")) == {}


@pytest.mark.attack("uploads", "a file that takes time")
def test_a_file_that_takes_time_costs_a_process_and_a_sentence(
    apart: SubprocessReader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "hangs.npy")
    monkeypatch.setattr(reading, "MAX_S", 0.3)
    (told,) = faults(apart, (tmp_path / "hangs.npy", "hangs.npy")).values()
    assert told.startswith("hangs.npy cannot be read within")
    assert len(children()) <= reading.PROCESSES


def test_one_that_was_killed_is_replaced(apart: SubprocessReader, tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "capture")
    assert faults(apart, (folder / "c0_l0.npy", "c0_l0.npy")) == {}
    for one in children():
        one.kill()
        one.wait(10)
    assert apart.describe(folder).image_px == 2 * 48


@pytest.mark.attack("uploads", "secrets of the server beside what reads uploads")
def test_it_knows_nothing_of_the_server(
    apart: SubprocessReader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DENTINE__SERVER__DATABASE", "postgresql://a:secret@b/c")
    fresh = SubprocessReader()
    try:
        fresh.describe(write_capture(tmp_path / "capture"))
        assert not any("DENTINE" in name for one in children() for name in one.environ())
    finally:
        fresh.close()


def test_a_raw_capture_of_20_gigabytes_is_looked_at_by_its_headers(apart: SubprocessReader, tmp_path: Path) -> None:
    files = []
    for number in range(FILES):
        path = tmp_path / f"raw_{number}.npy"
        with path.open("wb") as stream:
            np.lib.format.write_array_header_1_0(
                stream, {"descr": "<u2", "fortran_order": False, "shape": (FILE_BYTES // 2,)}
            )
            stream.truncate(stream.tell() + FILE_BYTES)
        files.append((path, path.name))
    assert sum(path.stat().st_size for path, _ in files) > 20 * 10**9
    assert faults(apart, *files) == {}
    with files[-1][0].open("ab") as stream:
        stream.write(b"\0")
    assert "export it again" in faults(apart, *files)[files[-1][1]]


@pytest.mark.attack("uploads", "the commit of such a description")
def test_a_commit_tells_of_a_costly_file_and_the_next_one_goes_on(tmp_path: Path) -> None:
    contents = contents_of(write_capture(tmp_path / "capture"))
    worse = contents | {
        "capture.json": contents["capture.json"][:-1]
        + b', "more": ['
        + b"{}," * (MAX_DESCRIPTION_BYTES // 3 - 1000)
        + b"{}]}"
    }
    with serving(create_app(ServerSettings(data=tmp_path / "data", uploads=LIMITS), lambda *_: None)) as client:
        for files, status in ((worse, 409), (contents, 200)):
            capture = announce(client, files)
            for path in (file["path"] for file in capture["files"] if not file["is_known"]):
                assert send(client, capture["id"], path, files[path]).status_code == 204
            answer: httpx.Response = client.post(f"/v1/captures/{capture['id']}/commit")
            assert answer.status_code == status, answer.text
            if status == 409:
                assert [file["path"] for file in answer.json()["files"]] == ["capture.json"]
        assert (
            json.loads(contents["capture.json"])["lights"][0]["name"]
            == client.get(f"/v1/captures/{capture['id']}/calibration").json()["lights"][0]["name"]
        )
