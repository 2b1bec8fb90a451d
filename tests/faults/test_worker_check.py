"""A worker that cannot run a kind of task gets no such task and does not count as able. It states the reason in its
log, to the server and to its container.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.capture import stage as capture_stage
from services.cli.dask import _with_resources
from services.core.errors import PlatformError
from services.core.placement import DOME, STAGES
from services.fit import stage as fit_stage
from services.pipeline.worker_check import fault_of
from services.pipeline.worker_health import Sign, require_healthy_workers
from services.preprocess import stage as preprocess_stage
from tests.support.live_server import toy_server
from tests.support.small_system import PATIENCE_S, ROOT, free_port

pytestmark = pytest.mark.timeout(600)
IMPORTED_AS = {"pillow": "PIL", "opencv-contrib-python-headless": "cv2", "openexr": "OpenEXR"}


def environment(folder: Path, *, broken: str | None = None) -> dict[str, str]:
    """Environment of a process with its own temporary folder for signs of life and, if ``broken`` is given, with a
    package that cannot be imported.
    """
    paths = [str(ROOT)]
    if broken is not None:
        (folder / "shadow" / broken).mkdir(parents=True)
        (folder / "shadow" / broken / "__init__.py").write_text(
            "raise ModuleNotFoundError(\"No module named 'x'\", name='x')"
        )
        paths.insert(0, str(folder / "shadow"))
    (folder / "tmp").mkdir(parents=True, exist_ok=True)
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(folder / "tmp")}


@contextmanager
def process(log: Path, env: dict[str, str], *arguments: str) -> Iterator[None]:
    command = [sys.executable, "-m", "services", *arguments]
    with log.open("w") as stream, subprocess.Popen(command, stdout=stream, stderr=stream, env=env) as running:
        try:
            yield
        finally:
            running.terminate()
            running.wait(PATIENCE_S)


def worker_health(env: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services.pipeline.worker_health"]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


def workers_check(client: httpx.Client) -> tuple[int, str]:
    answer = client.get("/v1/health/ready")
    return answer.status_code, next(
        check["sentence"] for check in answer.json()["checks"] if check["name"] == "workers"
    )


def until(client: httpx.Client, status: int, text: str) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while (told := workers_check(client))[0] != status or text not in told[1]:
        assert time.monotonic() < deadline, told
        time.sleep(0.2)
    return told[1]


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, str, Path]]:
    """Client of a server whose scheduler has no workers yet, the scheduler's address, and the folder of the logs."""
    folder, port = tmp_path_factory.mktemp("system"), str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    with (
        process(folder / "scheduler.log", environment(folder), *scheduler),
        toy_server(folder / "data", scheduler=address) as (client, _),
    ):
        yield client, address, folder


def worker(address: str, folder: Path, env: dict[str, str], *options: str) -> Any:
    folder.mkdir(exist_ok=True)
    local = ("--nworkers", "1", "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder / "dask"))
    return process(folder / "worker.log", env, "worker", address, *local, *options)


@pytest.mark.dear("Workers of every kind start as processes, each with its own check of the renderer.")
def test_ready_counts_only_workers_that_can_work(system: tuple[httpx.Client, str, Path], tmp_path: Path) -> None:
    client, address, _ = system
    until(client, 503, "The scheduler has no workers")
    with ExitStack() as stack:
        unable = environment(tmp_path / "unable", broken="drjit")
        stack.enter_context(worker(address, tmp_path / "unable", unable))
        told = until(client, 503, "None of the 1 connected workers can run stages")
        sentence = "The package x is not installed; install dentine[fit] on this machine."
        assert sentence in told
        assert sentence in (tmp_path / "unable" / "worker.log").read_text()
        while "fault" not in (health := worker_health(unable)).stderr and sentence not in health.stderr:
            time.sleep(0.2)
        assert (health.returncode, health.stderr.strip()) == (PlatformError.exit_status, f"dentine: {sentence}")

        job = client.post("/v1/jobs", json={"capture": str(tmp_path), "workers": 1}).json()["id"]
        rig = environment(tmp_path / "rig")
        stack.enter_context(worker(address, tmp_path / "rig", rig, "--captures-only"))
        until(client, 503, "None of the 2 connected workers can run stages")
        able = environment(tmp_path / "able")
        stack.enter_context(worker(address, tmp_path / "able", able))
        assert until(client, 200, "can run") == "1 worker can run stages, 1 can capture."
        listed = {one["has_dome"]: one for one in client.get("/v1/workers").json()["workers"]}
        assert set(listed) == {True, False}
        faults = {
            one["fault"]: (one["runs_stages"], one["has_dome"]) for one in client.get("/v1/workers").json()["workers"]
        }
        assert faults[sentence] == (False, False)
        client.get(f"/v1/jobs/{job}/events", timeout=PATIENCE_S)
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "SUCCEEDED"
        while (health := worker_health(able)).returncode:
            time.sleep(0.2)
        assert health.stdout == "1 worker of this machine can work.\n"
        command = [sys.executable, "-m", "services", "worker-health"]
        assert subprocess.run(command, env=able, capture_output=True, text=True, check=True).stdout == health.stdout


def test_a_worker_without_signs_of_life_is_not_healthy(tmp_path: Path) -> None:
    with pytest.raises(PlatformError, match="No worker of this machine"):
        require_healthy_workers(tmp_path)
    sign = Sign(tmp_path / "1.json")
    sign.give("")
    assert require_healthy_workers(tmp_path) == 1
    os.utime(sign.path, (0, 0))
    with pytest.raises(PlatformError, match="No worker of this machine"):
        require_healthy_workers(tmp_path)


def test_a_check_that_breaks_its_process_or_hangs_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "cv2"
    broken.mkdir()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(tmp_path), str(ROOT))))
    (broken / "__init__.py").write_text("import os; os.abort()")
    assert "was ended by SIGABRT" in fault_of([STAGES])
    (broken / "__init__.py").write_text("import time; time.sleep(3600)")
    assert "did not end within 0.5 s" in fault_of([STAGES], timeout_s=0.5)


def test_every_package_of_an_extra_is_tried() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, stage in (("capture", capture_stage), ("preprocess", preprocess_stage), ("fit", fit_stage)):
        names = {requirement.partition(">")[0] for requirement in extras[extra]}
        assert {IMPORTED_AS.get(name, name) for name in names} == set(stage.PACKAGES)


@pytest.mark.parametrize(
    ("given", "claimed"),
    [
        ([], "STAGES=7"),
        (["--resources", "DOME=1"], "STAGES=7 DOME=1"),
        (["--resources=DOME=1 STAGES=2"], "STAGES=2 DOME=1"),
    ],
)
def test_what_a_worker_claims_is_added_to_its_own_resources(given: list[str], claimed: str) -> None:
    assert _with_resources(["tcp://s:1", *given, "--nthreads", "1"], {STAGES: 7}) == [
        "tcp://s:1",
        "--nthreads",
        "1",
        "--resources",
        claimed,
    ]


def test_a_rig_needs_no_renderer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = environment(tmp_path, broken="drjit")
    monkeypatch.setenv("PYTHONPATH", env["PYTHONPATH"])
    assert fault_of([DOME]) == ""
    assert "dentine[fit]" in fault_of([STAGES])
