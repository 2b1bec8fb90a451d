"""Tasks of an operator: back up and restore, change passwords and certificates, add a machine, stop and start."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.containers.composed_system import COMPOSE_FILES, JOB, ROOT, ComposedSystem, follow

DEPLOY = ROOT / "deploy"


@pytest.fixture(scope="module")
def finished(system: ComposedSystem, token: str, mouth: Path) -> str:
    """Id of a job that has succeeded."""
    capture = system.run_dentine(token, "upload", str(mouth), "--server", system.address, cwd=mouth).strip()
    with system.client(token) as client:
        job = str(client.post("/v1/jobs", json=JOB | {"capture": capture, "workers": 1}).json()["id"])
        assert follow(client, job)["state"] == "SUCCEEDED"
    return job


def digests(system: ComposedSystem, token: str, job: str) -> dict[str, str]:
    """SHA-256 of every artifact of a job, as the API delivers it."""
    with system.client(token) as client:
        paths = [one["path"] for one in client.get(f"/v1/jobs/{job}/artifacts").json()]
        return {
            path: hashlib.sha256(client.get(f"/v1/jobs/{job}/artifacts/{path}").content).hexdigest() for path in paths
        }


def script(system: ComposedSystem, name: str, folder: Path, *, check: bool = True) -> subprocess.CompletedProcess[str]:
    files = " ".join(f"--file {file}" for file in COMPOSE_FILES)
    compose = os.environ.get("DENTINE_COMPOSE", "docker compose")
    environment = system.environment | {"DENTINE_COMPOSE": f"{compose} --project-name {system.project} {files}"}
    done = subprocess.run(
        [str(DEPLOY / name), str(folder)], env=environment, capture_output=True, text=True, check=False
    )
    assert not check or done.returncode == 0, done.stdout + done.stderr
    return done


def test_a_backup_brings_everything_back(
    system: ComposedSystem, token: str, finished: str, tmp_path: Path, figures: dict[str, Any]
) -> None:
    before = digests(system, token, finished)
    script(system, "backup.sh", tmp_path / "backup")
    system.down("--volumes", "--timeout", "20")
    for one in system.data.iterdir():
        if one.name != "lost+found":
            shutil.rmtree(one) if one.is_dir() else one.unlink()
    system.up()
    script(system, "restore.sh", tmp_path / "backup")
    system.wait_until(lambda: system.is_ready(token), "the restored system does not become ready")
    assert digests(system, token, finished) == before
    figures["restored_files"] = len(before)


def test_a_damaged_backup_is_refused_before_anything_is_changed(
    system: ComposedSystem, token: str, finished: str, tmp_path: Path
) -> None:
    script(system, "backup.sh", tmp_path / "backup")
    with (tmp_path / "backup" / "data.tar").open("r+b") as stream:
        stream.seek(10_000)
        stream.write(b"damage")
    told = script(system, "restore.sh", tmp_path / "backup", check=False)
    assert (told.returncode, "nothing was changed" in told.stderr) == (5, True)
    assert digests(system, token, finished)


def test_a_new_database_password_needs_no_restart(system: ComposedSystem, token: str, finished: str) -> None:
    started = system.inspect(system.container("api"))["State"]["StartedAt"]
    before = system.inside("api", "cat", "/secrets/database/password")
    system.compose("run", "--rm", "--no-deps", "change-password")
    assert system.inside("api", "cat", "/secrets/database/password") != before
    system.engine(
        "restart", system.container("postgres")
    )  # ends all connections, so that the API must connect with the new password
    system.wait_until(lambda: system.is_ready(token), "the API does not come back with the new password")
    assert system.inspect(system.container("api"))["State"]["StartedAt"] == started
    with system.client(token) as client:
        assert (
            client.post(f"/v1/jobs/{finished}/retry").status_code == 409
        )  # a refusal of the API itself, which has read the database


def test_a_wrong_password_is_told_in_one_sentence(system: ComposedSystem) -> None:
    told = system.compose(
        "run",
        "--rm",
        "--no-deps",
        "--env",
        "DENTINE__SERVER__DATABASE_PASSWORD_FILE=/etc/hostname",
        "--env",
        "DENTINE__SERVER__DATA=/tmp/other",
        "api",
        "dentine",
        "serve",
        check=False,
    )
    sentences = [line for line in told.splitlines() if line.startswith("dentine: ")]
    assert sentences == [line for line in told.splitlines() if "password authentication failed" in line]
    assert len(sentences) == 1


def test_certificates_are_renewed(system: ComposedSystem, token: str, mouth: Path, finished: str) -> None:
    before = system.inside("api", "sha256sum", "/secrets/tls/tls.crt", "/secrets/tls/ca.crt").split()
    system.compose("run", "--rm", "--no-deps", "secrets", "dentine", "secrets", "make", "/secrets", "--renew")
    after = system.inside("api", "sha256sum", "/secrets/tls/tls.crt", "/secrets/tls/ca.crt").split()
    assert (before[0] != after[0], before[2]) == (True, after[2])
    system.compose("restart", "scheduler", "worker", "rig", "api")
    system.wait_until(lambda: system.is_ready(token), "the parts do not trust each other's new certificate")


@contextmanager
def further_machine(system: ComposedSystem, folder: Path) -> Iterator[None]:
    """Run another compose project with one worker, as a further host on the scheduler's network would."""
    secrets = folder / "secrets"
    for name in ("tls", "database"):
        volume = system.engine(
            "volume",
            "inspect",
            "--format",
            "{{.Mountpoint}}",
            f"{system.project}_{'tls' if name == 'tls' else 'password'}",
        ).strip()
        shutil.copytree(volume, secrets / name, symlinks=True)
        for one in [secrets / name, *(secrets / name).iterdir()]:
            os.chown(one, 10001, 10001)
    system.engine("network", "connect", system.network("parts"), system.container("postgres"), check=False)
    environment = system.environment | {
        "DENTINE_SERVER": system.address_of("scheduler", "parts"),
        "DENTINE_DATABASE_HOST": system.address_of("postgres", "parts"),
        "DENTINE_DATA": str(system.data),
        "DENTINE_SECRETS": str(secrets),
        "DENTINE_WORKER_NETWORK": system.network("parts"),
    }
    compose = [
        *os.environ.get("DENTINE_COMPOSE", "docker compose").split(),
        "--project-name",
        f"{system.project}further",
    ]
    compose += ["--file", str(DEPLOY / "compose.worker.yaml")]
    subprocess.run([*compose, "up", "--detach"], env=environment, check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run([*compose, "down", "--volumes"], env=environment, check=True, capture_output=True)
        system.engine("network", "disconnect", system.network("parts"), system.container("postgres"), check=False)


def test_a_second_machine_joins_in_one_command(
    system: ComposedSystem, token: str, mouth: Path, finished: str, tmp_path: Path
) -> None:
    def able() -> int:
        with system.client(token) as client:
            return sum(not one["has_dome"] for one in client.get("/v1/workers").json()["workers"])

    alone = able()
    with further_machine(system, tmp_path):
        system.wait_until(lambda: able() == alone + 1, "the further worker does not join")
        with system.client(token) as client:
            spec = client.get(f"/v1/jobs/{finished}").json()["spec"]
            job = client.post("/v1/jobs", json=JOB | {"capture": spec["capture"], "workers": 2}).json()["id"]
            assert follow(client, job)["state"] == "SUCCEEDED"
            both = [client.get(f"/v1/jobs/{one}/artifacts/parameters.json").json() for one in (finished, job)]
    for one in both:
        one.pop("seconds", None)
    assert both[0] == both[1]


def test_down_keeps_what_is_stored(system: ComposedSystem, token: str, finished: str) -> None:
    before = digests(system, token, finished)
    system.down("--timeout", "20")
    system.up()
    assert digests(system, token, finished) == before
