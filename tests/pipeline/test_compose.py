"""The compose file is valid, and the services that it starts work together.

Its commands and environments are run as processes on loopback, and they run a small job.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
import yaml

from services.core.verdict import NOT_CONVERGED_STATUS
from tests.support.live_server import connect
from tests.support.postgres import PostgresServer, new_database, postgres_server
from tests.support.small_system import free_port

ROOT = Path(__file__).parents[2]
COMPOSE = ROOT / "deploy" / "compose.yaml"
DENTINE = [sys.executable, "-m", "services"]
PATIENCE_S = 600.0
JOB = """
capture = "mouth"
boundary = "matched"
dentin = "known"
samples_per_pixel = 16
max_samples_per_pixel = 16
max_steps = 1
search_candidates = 100
advise = false
"""

pytestmark = pytest.mark.timeout(1800)


def services() -> dict[str, dict[str, Any]]:
    """Services that start without a profile, with the default values of their variables."""
    text = COMPOSE.read_text()
    for _ in range(2):  # a default may name another variable
        text = re.sub(r"\$\{\w+:-([^${}]*)\}", r"\1", text)
    return {name: one for name, one in yaml.safe_load(text)["services"].items() if "profiles" not in one}


def test_whoever_speaks_dask_speaks_tls() -> None:
    of_dask = {
        name
        for name, one in services().items()
        if "scheduler" in str(one.get("command")) or "DENTINE__SERVER__SCHEDULER" in one.get("environment", {})
    }
    assert of_dask == {"api", "scheduler", "worker", "rig"}
    assert all(services()[name]["environment"]["DENTINE__SERVER__TLS"] == "/secrets/tls" for name in of_dask)


def test_no_password_stands_in_a_variable() -> None:
    for name, one in services().items():
        for variable, value in one.get("environment", {}).items():
            assert "PASSWORD" not in variable or variable.endswith("_FILE"), (name, variable)
            assert not re.search(r"://[^/]*:[^/]*@", str(value)), (name, variable)


def test_only_the_api_is_published_and_only_on_loopback() -> None:
    assert {name: one["ports"] for name, one in services().items() if "ports" in one} == {
        "api": ["127.0.0.1:8000:8000"]
    }


def test_one_worker_alone_may_reach_the_dome() -> None:
    able = [name for name, one in services().items() if "--captures-only" in one.get("command", [])]
    assert able == ["rig"]
    assert "deploy" not in services()["rig"]


def test_each_network_has_those_who_need_it_and_leads_nowhere() -> None:
    networks = yaml.safe_load(COMPOSE.read_text())["networks"]
    assert [name for name, one in networks.items() if not (one or {}).get("internal")] == ["front"]
    members = {
        network: {name for name, one in services().items() if network in one.get("networks", [])}
        for network in networks
    }
    assert members["front"] == {"api"}
    assert members["parts"] == {"api", "scheduler", "worker", "rig"}
    assert members["database"] == {"api", "postgres", "worker", "rig"}
    assert members["dome"] == {"api", "rig", "dome"}
    assert members["default"] == set()


def test_the_authority_is_nobodys_but_that_of_whoever_makes_certificates() -> None:
    holders = {
        name
        for name, one in services().items()
        if any(volume.startswith("authority:") for volume in one.get("volumes", []))
    }
    assert holders == {"secrets"}


def test_every_service_is_checked_closed_and_starts_again() -> None:
    for name, one in services().items():
        assert one["read_only"], name
        assert one["cap_drop"] == ["ALL"], name
        assert one["security_opt"] == ["no-new-privileges:true"], name
        assert one["logging"]["options"]["max-size"], name
        if name != "secrets":
            assert {"healthcheck", "mem_limit"} <= one.keys(), name
            assert one["restart"] == "unless-stopped", name


def test_each_image_is_built_once() -> None:
    assert {name: one["build"]["target"] for name, one in services().items() if "build" in one} == {
        "api": "api",
        "worker": "worker",
    }


class Composition:
    """The file's services as processes, with host names and folders of this machine."""

    def __init__(self, folder: Path, postgres: PostgresServer) -> None:
        self._folder = folder
        ports = {"8786": str(free_port()), "8000": str(free_port()), "5020": str(free_port())}
        self.address = f"http://127.0.0.1:{ports['8000']}"
        database = services()["api"]["environment"]["DENTINE__SERVER__DATABASE"]
        self._names = {
            database: new_database(postgres, "composed"),
            "scheduler:": "127.0.0.1:",
            "dome:": "127.0.0.1:",
            "/data": str(folder / "data"),
            "/secrets": str(folder / "secrets"),
            "/tmp/dask": str(folder / "dask"),
        }
        self._names |= {port: mine for port, mine in ports.items() if port != "8000"} | {"8000": ports["8000"]}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def environment(self, name: str) -> dict[str, str]:
        """Environment of a service, added to that of this machine."""
        return (
            os.environ
            | {"PYTHONPATH": str(ROOT)}
            | {key: self._here(value or "") for key, value in services()[name].get("environment", {}).items()}
        )

    def command(self, name: str) -> list[str]:
        """Command line of a service, without the program's name."""
        program, *arguments = services()[name]["command"]
        assert program == "dentine"
        return [self._here(part) for part in arguments]

    def start(self, name: str) -> None:
        """Start a service by its own command."""
        with (self._folder / f"{name}.log").open("wb") as log:
            command = [*DENTINE, *self.command(name)]
            self._processes[name] = subprocess.Popen(
                command, env=self.environment(name), cwd=self._folder, stdout=log, stderr=log, start_new_session=True
            )

    def close(self) -> None:
        """End all services in order, as a container engine does."""
        for process in self._processes.values():
            below = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
            process.terminate()
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()
            for one in psutil.wait_procs(below, timeout=30)[1]:
                one.kill()

    def _here(self, text: str) -> str:
        for theirs, ours in self._names.items():
            text = (
                re.sub(rf"(?<!\w){re.escape(theirs)}\b", ours, text)
                if theirs.startswith("/")
                else text.replace(theirs, ours)
            )
        return text


@pytest.fixture
def composition(tmp_path: Path) -> Iterator[Composition]:
    with postgres_server() as postgres:
        made = Composition(tmp_path, postgres)
        try:
            for name in services():
                if name == "secrets":
                    dentine(tmp_path, made.environment(name), *made.command(name))
                elif name != "postgres":
                    made.start(name)
            deadline = time.monotonic() + PATIENCE_S
            while not _is_live(made.address):
                assert time.monotonic() < deadline, (tmp_path / "api.log").read_text()
                time.sleep(0.1)
            yield made
        finally:
            made.close()


def _is_live(address: str) -> bool:
    try:
        with connect(address) as client:
            return client.get("/v1/health/live").status_code == 200
    except httpx.TransportError:
        return False


def dentine(folder: Path, environment: Mapping[str, str], *arguments: str, ends_with: Collection[int] = (0,)) -> str:
    done = subprocess.run(
        [*DENTINE, *arguments], cwd=folder, env=dict(environment), capture_output=True, text=True, check=False
    )
    assert done.returncode in ends_with, done.stderr
    return done.stdout.strip()


@pytest.mark.dear("Every service of the file starts as a process, and one real job runs through all.")
def test_a_small_job_runs_through_what_the_file_starts(composition: Composition, tmp_path: Path) -> None:
    environment = composition.environment("api")
    with connect(composition.address) as client:
        assert client.get("/v1/jobs").status_code == 401
    token = dentine(tmp_path, environment, "token", "create", "laboratory", "--scope", "submit")
    environment |= {"DENTINE__CLIENT__TOKEN": token}

    size = ["--pixel-mm", "1.5", "--cameras", "1", "--lights", "4", "--samples", "64"]
    dentine(tmp_path, environment, "phantom", "--out", "mouth", *size)
    (tmp_path / "job.toml").write_text(JOB)
    # With so few pixels and paths the fit may not converge, which is not tested here.
    submit = ["submit", "job.toml", "--upload", "--watch", "--server", composition.address]
    job = dentine(tmp_path, environment, *submit, ends_with=(0, NOT_CONVERGED_STATUS)).splitlines()[0]

    headers = {"Authorization": f"Bearer {token}"}
    with connect(composition.address) as client:
        detail = client.get(f"/v1/jobs/{job}", headers=headers).json()
        assert detail["state"] == "SUCCEEDED"
        assert client.get("/v1/health/ready", headers=headers).status_code == 200
        report = client.get(f"/v1/jobs/{job}/artifacts/report.html", headers=headers)
        assert "Tooth" in report.text
        work_the_dome(client, dentine(tmp_path, environment, "token", "create", "operator", "--scope", "operate-dome"))
    for log in tmp_path.glob("*.log"):
        assert token not in log.read_text()


def work_the_dome(client: httpx.Client, token: str) -> None:
    """Read the dome's status, switch on a light and press ALL OFF over the composed API."""
    headers = {"Authorization": f"Bearer {token}"}
    told = client.get("/v1/dome", headers=headers).json()
    assert (told["capturing"], told["status"]["lit"], told["status"]["stopped"]) == ([], [], False)
    assert client.put("/v1/dome/light", json={"light": 3, "level": 0.05, "on_s": 30}, headers=headers).json()[
        "lit"
    ] == [3]
    dark = client.post("/v1/dome/off", headers=headers).json()["status"]
    assert (dark["lit"], dark["stopped"]) == ([], True)
    assert client.get("/v1/dome", headers=headers).json()["status"] == dark
