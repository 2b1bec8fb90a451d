"""Every part of the service in a virtual environment with only its own extras, and a small job that uses all of them:
``make roles``.

The job lights the simulated dome from the rig's worker, is submitted by a client without the server's packages, and is
fitted on a worker without them.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import httpx
import psutil
import pytest

from services.core.verdict import NOT_CONVERGED_STATUS
from tests.support.installed import build_wheel, environment_without_this_tree, install
from tests.support.live_server import connect
from tests.support.roles import ROLES
from tests.support.small_system import free_port

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]
PATIENCE_S = 300.0
PHANTOM = ["phantom", "--out", "mouth", "--pixel-mm", "1.5", "--cameras", "1", "--lights", "4", "--samples", "64"]
JOB = """
boundary = "matched"
dentin = "known"
samples_per_pixel = 16
max_samples_per_pixel = 16
max_steps = 1
search_candidates = 100
advise = false

[rig]
dome = "127.0.0.1:{port}"
mouth = "{mouth}"
"""
LIGHTS_OF_THE_DOME = 8


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folder of programs by role; roles with the same extras share one."""
    folder = tmp_path_factory.mktemp("roles")
    wheel = build_wheel(folder / "build")
    made = {
        extras: install(wheel, extras, folder / ("-".join(extras) or "base"))
        for extras in {role.extras for role in ROLES.values()}
    }
    return {name: made[role.extras] for name, role in ROLES.items()}


class Parts:
    """The parts of one service on loopback."""

    def __init__(self, programs: Mapping[str, Path], folder: Path) -> None:
        self._programs, self._folder = programs, folder
        self._ports = {name: free_port() for name in ("api", "scheduler", "dome")}
        self.address = f"http://127.0.0.1:{self._ports['api']}"
        self.dome = f"127.0.0.1:{self._ports['dome']}"
        scheduler = f"tcp://127.0.0.1:{self._ports['scheduler']}"
        worker = [
            "worker",
            scheduler,
            "--nworkers",
            "1",
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            str(folder / "dask"),
        ]
        self._commands = {
            "scheduler": [
                "scheduler",
                "--host",
                "127.0.0.1",
                "--port",
                str(self._ports["scheduler"]),
                "--no-dashboard",
            ],
            "dome": ["dome-sim", "--port", str(self._ports["dome"]), "--lights", str(LIGHTS_OF_THE_DOME)],
            "worker": worker,
            "rig": [*worker, "--resources", "DOME=1"],
            "api": ["serve", "--port", str(self._ports["api"]), "--data", str(folder / "data")],
        }
        self._settings = {"DENTINE__SERVER__SCHEDULER": scheduler, "DENTINE__SERVER__DOME__ADDRESS": self.dome}

    def start(self, name: str, stack: ExitStack) -> None:
        """Start a part by its own command; the stack ends it."""
        settings = self._settings if name == "api" else {}
        log = stack.enter_context(self.log(name).open("wb"))
        command = [str(self._programs[name] / "dentine"), *self._commands[name]]
        process = subprocess.Popen(
            command, cwd=self._folder, env=environment_without_this_tree(**settings), stdout=log, stderr=log
        )
        stack.callback(end, process)

    def run(self, role: str, *arguments: str, ends_with: Collection[int] = (0,)) -> str:
        """Run a command to its end in a role's environment; returns its output."""
        command = [str(self._programs[role] / "dentine"), *arguments]
        ended = subprocess.run(
            command, cwd=self._folder, env=environment_without_this_tree(), capture_output=True, text=True, check=False
        )
        assert ended.returncode in ends_with, f"{role}: {ended.stderr}\n{self.logs()}"
        return ended.stdout.strip()

    def log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def logs(self) -> str:
        """The last log lines of every part."""
        return "\n".join(f"{name}: {self.log(name).read_text()[-2000:]}" for name in self._commands)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, self.logs()
            time.sleep(0.2)

    def workers(self) -> int:
        """Number of workers that the API knows; 0 while it does not answer."""
        try:
            with connect(self.address) as client:
                return len(client.get("/v1/workers").raise_for_status().json()["workers"])
        except httpx.HTTPError:
            return 0


def end(process: subprocess.Popen[bytes]) -> None:
    below = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
    process.terminate()
    try:
        process.wait(60)
    except subprocess.TimeoutExpired:
        process.kill()
    for one in psutil.wait_procs(below, timeout=30)[1]:
        one.kill()


@pytest.fixture
def parts(programs: dict[str, Path], tmp_path: Path) -> Iterator[Parts]:
    made = Parts(programs, tmp_path)
    with ExitStack() as stack:
        for name in ("scheduler", "dome", "worker", "rig", "api"):
            made.start(name, stack)
        made.wait_until(lambda: made.workers() == 2)
        yield made


def test_a_small_job_runs_through_parts_that_have_only_their_own_packages(parts: Parts, tmp_path: Path) -> None:
    parts.run("worker", *PHANTOM)
    uploaded = json.loads(parts.run("client", "upload", "mouth", "--server", parts.address, "--json"))
    assert (tmp_path / "data" / uploaded["path"]).is_dir()

    (tmp_path / "job.toml").write_text(JOB.format(port=parts.dome.rpartition(":")[2], mouth=tmp_path / "mouth"))
    # With so few pixels and paths the fit may not converge, which is not tested here.
    job = parts.run(
        "client", "submit", "job.toml", "--watch", "--server", parts.address, ends_with=(0, NOT_CONVERGED_STATUS)
    ).splitlines()[0]
    with connect(parts.address) as client:
        detail = client.get(f"/v1/jobs/{job}").json()
        assert detail["state"] == "SUCCEEDED", detail
        assert {stage["stage"] for stage in detail["stages"]} == {"capture", "prepare", "fit", "export"}
        assert "Tooth" in client.get(f"/v1/jobs/{job}/artifacts/report.html").text
        assert client.put("/v1/dome/light", json={"light": 3, "level": 0.05, "on_s": 30}).json()["lit"] == [3]
        assert client.post("/v1/dome/off").json()["status"]["lit"] == []
    assert "Traceback" not in parts.logs()


def test_a_command_without_its_packages_names_the_extra(programs: dict[str, Path], tmp_path: Path) -> None:
    for arguments, extra in (
        (["serve", "--port", "0"], "api"),
        (["dome-sim", "--port", "0"], "capture"),
        (["phantom", "--out", "mouth"], "worker"),
    ):
        command = [str(programs["client"] / "dentine"), *arguments]
        ended = subprocess.run(
            command, cwd=tmp_path, env=environment_without_this_tree(), capture_output=True, text=True, check=False
        )
        assert (ended.returncode, ended.stdout) == (4, ""), ended.stderr
        assert f"'.[{extra}]'" in ended.stderr
        assert len(ended.stderr.splitlines()) == 1, ended.stderr
