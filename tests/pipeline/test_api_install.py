"""``dentine[api]`` alone is a complete server: installed into an empty environment, it starts, answers, and reports the
true state of a job that workers run elsewhere.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from services.api.app import is_dashboard_built
from tests.support.installed import build_wheel, environment_without_this_tree, install
from tests.support.live_server import running_server
from tests.support.small_system import free_port
from tests.support.uploading import write_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
ABSENT = (
    "mitsuba",
    "drjit",
    "cv2",
    "pymodbus",
    "scipy",
    "rtree",
    "manifold3d",
    "xatlas",
    "PIL",
    "matplotlib",
    "psycopg",
)


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with ``dentine[api]`` alone."""
    folder = tmp_path_factory.mktemp("installed")
    return install(build_wheel(folder / "build"), ["api"], folder / "venv").parent


@contextmanager
def served(environment: Path, data: Path, **settings: str) -> Iterator[httpx.Client]:
    """Run the installed server without access to this source tree; yields its client."""
    command = [str(environment / "bin/dentine"), "serve", "--port", "0", "--data", str(data)]
    with running_server(command, cwd=data.parent, environment=environment_without_this_tree(**settings)) as (client, _):
        yield client


def test_what_renders_captures_and_speaks_to_domes_is_absent(environment: Path) -> None:
    code = (
        f"import importlib.util, json; print(json.dumps([name for name in {ABSENT!r} if"
        " importlib.util.find_spec(name)]))"
    )
    answer = subprocess.run(
        [str(environment / "bin/python"), "-I", "-c", code], check=True, capture_output=True, text=True
    )
    assert json.loads(answer.stdout) == []


def test_the_server_answers_and_shows_its_page(environment: Path, tmp_path: Path) -> None:
    with served(environment, tmp_path / "data") as client:
        assert client.get("/v1/health/live").json() == {"status": "live"}
        while "being found out" in (ready := client.get("/v1/health/ready")).text:
            time.sleep(0.2)
        bad = [check for check in ready.json()["checks"] if not check["ok"]]
        sentence = (
            "This machine cannot run stages: The package cv2 is not installed; install dentine[preprocess] on this"
            " machine."
        )
        assert (ready.status_code, bad) == (503, [{"name": "workers", "ok": False, "sentence": sentence}])
        assert "<title>dentine</title>" in client.get("/").text
        assert client.get("/app.js").status_code == (200 if is_dashboard_built() else 404)
        assert "/v1/jobs" in client.get("/v1/openapi.json").json()["paths"]


def test_a_stage_whose_packages_are_absent_says_so(environment: Path, tmp_path: Path) -> None:
    with served(environment, tmp_path / "data") as client:
        job = client.post(
            "/v1/jobs", json={"rig": {"mouth": str(write_capture(tmp_path / "mine"))}, "workers": 1}
        ).json()["id"]
        client.get(f"/v1/jobs/{job}/events", timeout=300)
        detail = client.get(f"/v1/jobs/{job}").json()
    assert (detail["state"], detail["failure"]["code"]) == ("FAILED", "platform-missing")
    assert detail["failure"]["message"].startswith(
        "Stage capture needs pymodbus, which its workers do not have; install dentine[capture] "
    )


def test_a_job_waits_for_a_scheduler_elsewhere(environment: Path, tmp_path: Path) -> None:
    scheduler = f"tcp://127.0.0.1:{free_port()}"
    with served(environment, tmp_path / "data", DENTINE__SERVER__SCHEDULER=scheduler) as client:
        job = client.post("/v1/jobs", json={"capture": str(write_capture(tmp_path / "mine")), "workers": 1}).json()[
            "id"
        ]
        while (detail := client.get(f"/v1/jobs/{job}").json())["waits_for"] is None:
            assert detail["state"] in {"QUEUED", "RUNNING"}
            time.sleep(0.2)
        assert detail["waits_for"].startswith(f"Waits for workers: The scheduler {scheduler} does not answer")
        assert detail["remaining"]["reason"] == detail["waits_for"]
        assert client.get("/v1/health/ready").status_code == 503
