"""TLS between API, scheduler and workers by one setting: only programs with the authority's certificate can connect."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from services.core.errors import SchedulerLostError, SettingsError
from services.pipeline.dask_tls import Certificates
from services.pipeline.workers import Workers, require_scheduler
from tests.support.certificates import certificates
from tests.support.live_server import toy_server
from tests.support.small_system import free_port

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120.0


@contextmanager
def part(folder: Path, tls: Path, *arguments: str) -> Iterator[None]:
    """Run ``dentine scheduler`` or ``dentine worker`` with TLS for the time of the block."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "DENTINE__SERVER__TLS": str(tls)}
    with (folder / f"{arguments[0]}.log").open("wb") as log:
        command = [sys.executable, "-m", "services", *arguments, "--no-dashboard"]
        with subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log) as process:
            try:
                yield
            finally:
                process.terminate()
                try:
                    process.wait(30)
                except subprocess.TimeoutExpired:
                    process.kill()


def await_scheduler(address: str, tls: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            require_scheduler(address, Certificates.of(tls))
        except SchedulerLostError:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        else:
            return


def ready(client: httpx.Client) -> dict[str, str]:
    """Name and sentence of each part that the readiness route names as bad."""
    return {
        check["name"]: check["sentence"] for check in client.get("/v1/health/ready").json()["checks"] if not check["ok"]
    }


def await_ready(client: httpx.Client) -> None:
    """Wait until readiness names no bad part; the worker must first show that it can run stages."""
    until = time.monotonic() + PATIENCE_S
    while missing := ready(client):
        assert time.monotonic() < until, missing
        time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.attack("Dask and files as another user", "a scheduler by TLS, without a certificate")
def test_a_job_runs_by_tls_and_strangers_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.pipeline.workers.CONNECT_S", 2.0)
    ours, theirs, address = (
        certificates(tmp_path / "ours"),
        certificates(tmp_path / "theirs"),
        f"tcp://127.0.0.1:{free_port()}",
    )
    with (
        part(tmp_path, ours, "scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2]),
        part(
            tmp_path,
            ours,
            "worker",
            address,
            "--nworkers",
            "1",
            "--nthreads",
            "1",
            "--local-directory",
            str(tmp_path / "dask"),
        ),
    ):
        await_scheduler(address, ours)
        for stranger in (None, Certificates.of(theirs)):
            with pytest.raises(SchedulerLostError), Workers(address, stranger) as workers:
                workers.connect()
            with pytest.raises(SchedulerLostError):
                require_scheduler(address, stranger)
        with pytest.raises(SchedulerLostError, match="do not trust each other"):
            require_scheduler(address, Certificates.of(theirs))

        with toy_server(tmp_path / "data", scheduler=address, tls=str(ours)) as (client, _):
            await_ready(client)
            job = client.post("/v1/jobs", json={"capture": str(tmp_path), "workers": 1}).json()["id"]
            client.get(f"/v1/jobs/{job}/events")
            assert client.get(f"/v1/jobs/{job}").json()["state"] == "SUCCEEDED"
            assert client.get("/v1/workers").json()["sentence"] == "1 worker, 0 busy."


def test_a_folder_that_lacks_a_file_or_mixes_two_is_a_sentence(tmp_path: Path) -> None:
    ours, theirs = certificates(tmp_path / "ours"), certificates(tmp_path / "theirs")
    (ours / "tls.key").write_bytes((theirs / "tls.key").read_bytes())
    with pytest.raises(SettingsError, match=r"cannot be used \(.*\); tls\.key must be the key of tls\.crt"):
        Certificates.of(ours)
    (ours / "ca.crt").unlink()
    with pytest.raises(SettingsError, match=r"ours/ca\.crt does not exist"):
        Certificates.of(ours)
