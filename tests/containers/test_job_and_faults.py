"""A job in real containers gives the result of an undisturbed job after any part fails during it."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.containers.composed_system import JOB, ComposedSystem, follow
from tests.support.store_disk import StoreDisk

CUT_S, FULL_S = 60.0, 10.0
STAGES = {"prepare": "prepared", "fit": "fit", "export": "asset"}


@pytest.fixture(scope="module")
def capture(system: ComposedSystem, token: str, mouth: Path) -> str:
    """Path of the uploaded capture, as jobs name it."""
    return system.run_dentine(token, "upload", str(mouth), "--server", system.address, cwd=mouth).strip()


@pytest.fixture(scope="module")
def undisturbed(system: ComposedSystem, token: str, capture: str) -> dict[str, Any]:
    """Result of an undisturbed job."""
    job = submit(system, token, capture)
    return result_of(system, token, job)


def submit(system: ComposedSystem, token: str, capture: str) -> str:
    with system.client(token) as client:
        answer = client.post("/v1/jobs", json=JOB | {"capture": capture, "workers": 1})
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])


def result_of(system: ComposedSystem, token: str, job: str) -> dict[str, Any]:
    """A job's parameters without the time that it took; asserts that the job succeeded and that each stage was
    finished once, by the attempt that published it.
    """
    with system.client(token) as client:
        detail = follow(client, job)
        assert detail["state"] == "SUCCEEDED", detail["failure"]
        found = client.get(f"/v1/jobs/{job}/artifacts/parameters.json").json()
        events = [
            json.loads(line[6:])
            for line in client.get(f"/v1/jobs/{job}/events").text.splitlines()
            if line.startswith('data: {"id"')
        ]
    for stage, folder in STAGES.items():
        finished = [event["attempt"] for event in events if event["stage"] == stage and event["kind"] == "finished"]
        published = json.loads((system.data / "jobs" / job / folder / "manifest.json").read_text())["attempt"]
        assert finished == [published], (stage, finished, published)
    return {name: value for name, value in found.items() if name != "seconds"}


def test_the_asset_of_a_job_renders(
    system: ComposedSystem, token: str, undisturbed: dict[str, Any], tmp_path: Path
) -> None:
    assert undisturbed
    with system.client(token) as client:
        job = next(one["id"] for one in client.get("/v1/jobs").json()["jobs"] if one["state"] == "SUCCEEDED")
        packed = client.get(f"/v1/jobs/{job}/artifacts.zip")
    with zipfile.ZipFile(io.BytesIO(packed.content)) as results:
        results.extractall(tmp_path)
    script = next(tmp_path.rglob("render.py"))
    picture = tmp_path / "tooth.exr"
    subprocess.run([sys.executable, str(script), "--spp", "16", "--out", str(picture)], cwd=script.parent, check=True)
    assert picture.stat().st_size > 0


def kill(service: str) -> Callable[[ComposedSystem, StoreDisk], None]:
    """A fault that kills the container's first process by SIGKILL; its restart policy starts it again."""

    def strike(system: ComposedSystem, _disk: StoreDisk) -> None:
        os.kill(system.inspect(system.container(service))["State"]["Pid"], signal.SIGKILL)

    return strike


def cut_worker(system: ComposedSystem, _disk: StoreDisk) -> None:
    """Drop every packet to and from the worker for a minute, also if it restarts meanwhile; its addresses stay."""
    rules = (["INPUT", "!", "-i", "lo", "-j", "DROP"], ["OUTPUT", "!", "-o", "lo", "-j", "DROP"])
    cut, end = 0, time.monotonic() + CUT_S
    while time.monotonic() < end:
        pid = system.inspect(system.container("worker"))["State"]["Pid"]
        if pid not in {0, cut}:
            for rule in rules:
                subprocess.run(["nsenter", "--net", "--target", str(pid), "iptables", "-I", *rule], check=True)
            cut = pid
        time.sleep(0.2)
    for rule in rules:
        subprocess.run(["nsenter", "--net", "--target", str(cut), "iptables", "-D", *rule], check=True)


def fill_disk(_system: ComposedSystem, disk: StoreDisk) -> None:
    with disk.full():
        time.sleep(FULL_S)


def restart_api(system: ComposedSystem, _disk: StoreDisk) -> None:
    system.compose("restart", "api")


def down_and_up(system: ComposedSystem, _disk: StoreDisk) -> None:
    system.down("--timeout", "30")
    system.up()


FAULTS: dict[str, Callable[[ComposedSystem, StoreDisk], None]] = {
    "API restarted": restart_api,
    "worker killed": kill("worker"),
    "worker cut off": cut_worker,
    "scheduler killed": kill("scheduler"),
    "database killed": kill("postgres"),
    "disk full and freed": fill_disk,
    "down and up": down_and_up,
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_disturbed_job_gives_the_undisturbed_answer(
    system: ComposedSystem,
    disk: StoreDisk,
    token: str,
    capture: str,
    undisturbed: dict[str, Any],
    figures: dict[str, Any],
    name: str,
) -> None:
    job = submit(system, token, capture)
    system.wait_until(lambda: is_fitting(system, token, job), "the fit does not begin")
    start = time.monotonic()
    FAULTS[name](system, disk)
    found = result_of(system, token, job)
    figures.setdefault("seconds_from_fault_to_end", {})[name] = round(time.monotonic() - start, 1)
    assert found == undisturbed


def is_fitting(system: ComposedSystem, token: str, job: str) -> bool:
    try:
        with system.client(token) as client:
            return any(
                one["stage"] == "fit" and one["state"] == "running"
                for one in client.get(f"/v1/jobs/{job}").json()["stages"]
            )
    except (httpx.TransportError, KeyError):
        return False
