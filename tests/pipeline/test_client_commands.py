"""Commands that use a server: list, name, download, delete. They fail with one sentence, and need only the base
dependencies.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.command_line import dentine
from tests.support.live_server import serving
from tests.support.uploading import write_capture

ROOT = Path(__file__).parents[2]
BEYOND_THE_BASE = (
    "alembic",
    "fastapi",
    "uvicorn",
    "starlette",
    "structlog",
    "prometheus_client",
    "mitsuba",
    "drjit",
    "cv2",
    "scipy",
    "pymodbus",
    "psycopg",
)
WITHOUT = f"""
import json, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {BEYOND_THE_BASE!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from tests.support.command_line import dentine
for line in sys.stdin:
    print(json.dumps(vars(dentine(*json.loads(line)))), flush=True)
"""
"""Program that runs command lines with only the base dependencies of ``pip install dentine``: one a line, as JSON."""


class BareInstall:
    """A process with the base dependencies alone, and its command line."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def dentine(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run one command."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(arguments) + "\n")
        self._process.stdin.flush()
        return subprocess.CompletedProcess(**json.loads(self._process.stdout.readline()))


@pytest.fixture
def bare() -> Iterator[BareInstall]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", WITHOUT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        yield BareInstall(process)


def sentence(answer: subprocess.CompletedProcess[str]) -> str:
    assert answer.stdout == ""
    (line,) = answer.stderr.splitlines()
    assert re.fullmatch(r"dentine: .*[.]", line)
    return line


@pytest.fixture
def server(tmp_path: Path) -> Iterator[httpx.Client]:
    def run(_spec: object, folder: Path, _events: object) -> None:
        (folder / "report.html").write_text("<!doctype html>")
        (folder / "asset").mkdir()
        (folder / "asset" / "scene.xml").write_text("<scene/>")

    with serving(create_app(ServerSettings(data=tmp_path / "data"), run)) as client:
        yield client


def submitted(server: httpx.Client, **body: object) -> str:
    job = str(server.post("/v1/jobs", json={"capture": "/"} | body).json()["id"])
    server.get(f"/v1/jobs/{job}/events", timeout=60)
    return job


def test_a_job_is_named_listed_downloaded_and_deleted_by_the_base_install(
    tmp_path: Path, server: httpx.Client, bare: BareInstall
) -> None:
    address = ("--server", str(server.base_url))
    job_file = tmp_path / "job.toml"
    job_file.write_text(f'capture = "{write_capture(tmp_path / "mine")}"\n')
    made = bare.dentine("submit", str(job_file), "--upload", "--name", " Anna, upper left ", "--watch", *address)
    assert made.returncode == 0, made.stderr
    job = made.stdout.split()[0]
    listed = bare.dentine("jobs", *address)
    assert re.fullmatch(
        rf"{job}  SUCCEEDED      \d{{4}}-\d\d-\d\d \d\d:\d\d UTC  Anna, upper left  captures/\w+\n", listed.stdout
    )
    (told,) = json.loads(
        bare.dentine("jobs", "--state", "succeeded", "--capture", "captures/", "--json", *address).stdout
    )
    assert (told["id"], told["name"]) == (job, "Anna, upper left")
    assert bare.dentine("jobs", "--state", "failed", *address).stdout == "There is no such job.\n"

    zipped = tmp_path / "new" / "files.zip"
    assert bare.dentine("download", job, "--out", str(zipped), *address).stdout == f"{zipped}\n"
    with zipfile.ZipFile(zipped) as archive:
        assert archive.testzip() is None
        assert {"report.html", "asset/scene.xml"} <= set(archive.namelist())
    assert "exists already" in sentence(dentine("download", job, "--out", str(zipped), *address))

    receipt = json.loads(bare.dentine("delete", job, "--json", *address).stdout)
    assert (receipt["job"], receipt["files"]) == (job, 3)
    assert "There is no job" in sentence(dentine("delete", job, *address))
    assert "There is no job" in sentence(dentine("download", job, "--out", str(tmp_path / "gone.zip"), *address))
    assert not (tmp_path / "gone.zip").exists()


def test_httpx_comes_with_the_base_install() -> None:
    base = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert any(one.startswith("httpx") for one in base)


def test_more_jobs_are_listed_than_one_answer_holds(server: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.cli.client.jobs.MAX_AT_ONCE", 2)
    from services.cli.client.jobs import _list
    from services.client.client import Client

    jobs = [submitted(server, seed=seed) for seed in range(5)]
    with Client(str(server.base_url)) as client:
        assert [job["id"] for job in _list(client, 4, {})] == jobs[:0:-1]
        assert len(_list(client, 9, {})) == 5


def test_a_job_under_way_is_not_deleted(tmp_path: Path) -> None:
    started, released = threading.Event(), threading.Event()

    def run(*_: object) -> None:
        started.set()
        released.wait(60)

    with serving(create_app(ServerSettings(data=tmp_path / "data"), run)) as client:
        job = client.post("/v1/jobs", json={"capture": str(tmp_path)}).json()["id"]
        assert started.wait(60)
        refused = dentine("delete", job, "--server", str(client.base_url))
        assert refused.returncode == 2
        assert "A job that is RUNNING does not take 'delete'; it takes cancel" in sentence(refused)
        released.set()


@pytest.mark.parametrize(
    "arguments", [("jobs",), ("delete", "x"), ("download", "x"), pytest.param(("watch", "x"), marks=pytest.mark.slow)]
)
def test_no_server_is_a_sentence(arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    answer = dentine(*arguments, "--server", "http://127.0.0.1:9")
    assert (answer.returncode, answer.stdout) == (4, "")
    assert "http://127.0.0.1:9" in answer.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_a_capture_that_the_server_lacks_names_the_ways(tmp_path: Path, server: httpx.Client) -> None:
    job_file = tmp_path / "job.toml"
    job_file.write_text('capture = "nowhere"\n')
    assert "upload it, with dentine submit --upload" in sentence(
        dentine("submit", str(job_file), "--server", str(server.base_url))
    )
    job_file.write_text('[rig]\nmouth = "nowhere"\n')
    assert "dentine submit --upload, or try the demonstration with dentine demo" in sentence(
        dentine("submit", str(job_file), "--server", str(server.base_url))
    )
    assert (
        "is not a folder; give the folder that holds capture.json"
        in dentine("submit", str(job_file), "--upload", "--server", str(server.base_url)).stderr
    )


def test_a_mouth_is_uploaded_used_and_kept_while_a_job_names_it(tmp_path: Path, server: httpx.Client) -> None:
    write_capture(tmp_path / "mine")
    job_file = tmp_path / "job.toml"
    job_file.write_text('[rig]\nmouth = "mine"\n')
    made = dentine("submit", str(job_file), "--upload", "--json", "--server", str(server.base_url))
    job = json.loads(made.stdout)
    mouth = job["spec"]["rig"]["mouth"]
    assert re.fullmatch(r"captures/\w+", mouth)
    refused = server.delete(f"/v1/captures/{mouth.removeprefix('captures/')}")
    assert (refused.status_code, refused.json()["code"]) == (409, "capture-state")
    assert server.post("/v1/jobs", json={"rig": {"mouth": "captures/none"}}).status_code == 422


@pytest.mark.parametrize("name", ["", "   ", "x" * 81, "two\nlines", "bell\x07", 7])
def test_a_name_is_one_line_of_80_characters(server: httpx.Client, name: object) -> None:
    refused = server.post("/v1/jobs", json={"capture": "/", "name": name})
    assert (refused.status_code, refused.json()["code"]) == (422, "bad-settings")
    assert "name" in refused.json()["detail"]


def test_a_job_is_renamed_and_its_options_stay(server: httpx.Client) -> None:
    job = submitted(server, name="Ärztin 1 – links")
    assert server.get(f"/v1/jobs/{job}").json()["name"] == "Ärztin 1 – links"
    assert "name" not in server.get(f"/v1/jobs/{job}").json()["spec"]
    assert server.patch(f"/v1/jobs/{job}", json={"name": "x" * 80}).json()["name"] == "x" * 80
    assert server.get("/v1/jobs").json()["jobs"][0]["name"] == "x" * 80
    assert server.patch(f"/v1/jobs/{job}", json={"name": None}).json()["name"] is None
    assert server.patch("/v1/jobs/none", json={"name": "x"}).status_code == 404
    assert server.patch(f"/v1/jobs/{job}", json={"state": "FAILED"}).status_code == 422


def test_the_same_key_makes_one_job_whatever_its_name(server: httpx.Client) -> None:
    first, second = (
        server.post("/v1/jobs", json={"capture": "/", "name": name}, headers={"Idempotency-Key": "k"})
        for name in ("one", "two")
    )
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json()["id"] == second.json()["id"]
    assert second.json()["name"] == "one"
