"""Readiness and metrics are correct while the database, the scheduler, the store or the disk fails, and after it works
again.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from pydantic import SecretStr

from services.api.app import create_app
from services.api.health import readiness as readiness_module
from services.api.health.readiness import Readiness
from services.api.jobs.admission import KEPT_FREE_BYTES
from services.api.jobs.jobs import Jobs
from services.api.migrations import upgrade
from services.core.settings import DATABASE_FILE, ServerSettings
from services.pipeline.database import open_database, sqlite_url
from tests.support.live_server import serving
from tests.support.postgres import new_database, postgres_server
from tests.support.small_system import free_port

NOBODY = 65534


@pytest.fixture
def client(tmp_path: Path) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as client:
        yield client


def bad_checks(client: httpx.Client) -> dict[str, str]:
    """Name and sentence of each failing check; asserts that status, problem document and metrics agree with them."""
    answer = client.get("/v1/health/ready")
    told = answer.json()
    assert [check["name"] for check in told["checks"]] == ["database", "scheduler", "workers", "store", "disk"]
    bad = {check["name"]: check["sentence"] for check in told["checks"] if not check["ok"]}
    if bad:
        assert (answer.status_code, told["status"], told["code"]) == (503, 503, "not-ready")
        assert answer.headers["content-type"] == "application/problem+json"
        assert told["detail"] == " ".join(bad.values())
    else:
        assert (answer.status_code, told["status"]) == (200, "ready")
    assert client.get("/v1/health/live").json() == {"status": "live"}
    scraped = client.get("/v1/metrics")
    assert scraped.status_code == 200
    for check in told["checks"]:
        assert f'dentine_up{{part="{check["name"]}"}} {float(check["ok"])}' in scraped.text
    assert ("dentine_jobs{" in scraped.text) is ("database" not in bad)
    return bad


@contextmanager
def locked(data: Path) -> Iterator[None]:
    with closing(sqlite3.connect(data / DATABASE_FILE, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


@contextmanager
def moved(data: Path) -> Iterator[None]:
    hidden = data / "hidden"
    (data / DATABASE_FILE).rename(hidden)
    yield
    hidden.rename(data / DATABASE_FILE)


@contextmanager
def without_folder(data: Path) -> Iterator[None]:
    shutil.rmtree(data / "jobs", ignore_errors=True)
    (data / "jobs").touch()
    yield
    (data / "jobs").unlink()


@pytest.mark.parametrize(
    ("fault", "part", "sentence"),
    [
        (locked, "database", "grants no write"),
        (moved, "database", "was removed or replaced"),
        (without_folder, "store", "cannot be written"),
    ],
)
def test_a_fault_is_named_while_it_lasts(
    client: httpx.Client, tmp_path: Path, fault: Callable[[Path], Any], part: str, sentence: str
) -> None:
    assert bad_checks(client) == {}
    with fault(tmp_path):
        bad = bad_checks(client)
    assert set(bad) == {part}
    assert sentence in bad[part]
    assert bad_checks(client) == {}


def test_a_database_replaced_under_the_server_is_told(tmp_path: Path) -> None:
    jobs = Jobs(ServerSettings(data=tmp_path), lambda *_: None)
    readiness = Readiness(jobs.repository.engine, tmp_path / "jobs", lambda: True, jobs.free_bytes)
    assert all(check.ok for check in readiness.checks())
    with moved(tmp_path):
        upgrade(open_database(sqlite_url(tmp_path / DATABASE_FILE)))
        assert [check.name for check in readiness.checks() if not check.ok] == ["database"]
    jobs.repository.close()


def test_a_disk_that_is_almost_full_is_told(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as full:
        full.setattr(
            shutil, "disk_usage", lambda _path: SimpleNamespace(free=KEPT_FREE_BYTES - 1, total=2 * KEPT_FREE_BYTES)
        )
        assert bad_checks(client) == {"disk": "Only 255 MiB of disk are free; free at least 256 MiB."}
    assert bad_checks(client) == {}


def test_a_disk_that_takes_no_byte_is_told(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as failing:
        failing.setattr("services.api.health.readiness.os.fsync", full)
        assert bad_checks(client) == {
            "store": (
                "The jobs' folder cannot be written (No space left on device); check its rights, its mount and the"
                " disk."
            )
        }
    assert bad_checks(client) == {}
    assert list((tmp_path / "jobs").iterdir()) == []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_runner_that_died_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(*_: object, **__: object) -> None:
        raise SystemExit  # ends the thread that starts jobs

    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as client:
        assert bad_checks(client) == {}
        monkeypatch.setattr("services.api.jobs.admission.Admission.holds", die)
        job = client.post("/v1/jobs", json={"capture": "/"}).json()["id"]
        while client.get("/v1/health/ready").status_code == 200:
            pass
        assert set(bad_checks(client)) == {"scheduler"}
        assert (
            client.get(f"/v1/jobs/{job}").json()["waits_for"]
            == "This server does not run jobs; restart it and read its log."
        )


def test_a_read_only_data_folder_is_told() -> None:
    """Readiness is checked as a user without root's rights, because root may write anywhere."""
    data = Path(tempfile.mkdtemp())
    try:
        data.chmod(0o755)
        jobs = Jobs(ServerSettings(data=data), lambda *_: None)
        (data / "jobs").mkdir(mode=0o755)
        readiness = Readiness(jobs.repository.engine, data / "jobs", lambda: True, jobs.free_bytes)
        assert all(check.ok for check in readiness.checks())
        jobs.repository.close()
        for path in (data, *data.rglob("*")):
            path.chmod(0o555 if path.is_dir() else 0o444)
        with unprivileged():
            bad = {check.name: check.sentence for check in readiness.checks() if not check.ok}
        jobs.repository.close()
        assert set(bad) == {"database", "store"}
        assert "readonly database" in bad["database"] or "unable to open" in bad["database"]
        assert "Permission denied" in bad["store"]
    finally:
        for path in (data, *data.rglob("*")):
            path.chmod(0o755)
        shutil.rmtree(data)


@contextmanager
def unprivileged() -> Iterator[None]:
    """Drop root's rights for the time of the block, if the process has them."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_scheduler_that_does_not_answer_is_told(tmp_path: Path) -> None:
    port = free_port()
    settings = ServerSettings(data=tmp_path, scheduler=f"tcp://127.0.0.1:{port}")
    told = {"scheduler": f"The scheduler {settings.scheduler} does not answer; start it, jobs wait for it."}
    with serving(create_app(settings, lambda *_: None)) as client:
        assert bad_checks(client) == told
        command = [
            sys.executable,
            "-m",
            "dask",
            "scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            str(port),
            "--no-dashboard",
        ]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as scheduler:
            try:
                while client.get("/v1/health/ready").status_code != 200:
                    assert scheduler.poll() is None
                assert bad_checks(client) == {}
                scheduler.send_signal(signal.SIGSTOP)  # the kernel still accepts connections for it
                assert bad_checks(client) == told
                scheduler.send_signal(signal.SIGCONT)
                while client.get("/v1/health/ready").status_code != 200:
                    assert scheduler.poll() is None
            finally:
                scheduler.kill()
        assert bad_checks(client) == told


def test_a_postgres_that_is_killed_is_told(tmp_path: Path) -> None:
    with postgres_server() as postgres:
        settings = ServerSettings(data=tmp_path, database=SecretStr(new_database(postgres, "ready")))
        with serving(create_app(settings, lambda *_: None)) as client:
            assert bad_checks(client) == {}
            postgres.kill()
            bad = bad_checks(client)
            assert set(bad) == {"database"}
            assert "cannot be written" in bad["database"]
            assert client.get("/v1/jobs").json()["code"] == "database-lost"
            postgres.start()
            assert bad_checks(client) == {}


def test_a_store_that_hangs_is_told(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    thawed = threading.Event()
    monkeypatch.setattr(readiness_module, "STORE_PROBE_S", 0.2)
    with monkeypatch.context() as frozen:
        frozen.setattr("services.api.health.readiness.os.fsync", lambda _descriptor: thawed.wait())
        try:
            assert bad_checks(client) == {
                "store": "The jobs' folder takes no file within 0.2 s; look at its disk, or at the network to it."
            }
        finally:
            thawed.set()
    monkeypatch.undo()
    assert bad_checks(client) == {}
