"""Outsiders get access to no part of the system: another container on each of its networks, and another user of the
host.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.containers.composed_system import ComposedSystem

NETWORKS = ("front", "parts", "database", "dome")
STRANGER = Path(__file__).with_name("stranger.py")
NOBODY = 65534
PYTHON = shutil.which("python3", path=os.defpath) or sys.executable
"""The system's Python, because another user may have no access to the folder of this one."""
POSTGRES, SCHEDULER, API, DOME = 5432, 8786, 8000, 5020
_LISTENING = "0A"


def listening(system: ComposedSystem, service: str) -> set[int]:
    """TCP ports on which a container listens on addresses other than its own loopback."""
    lines = system.inside(service, "cat", "/proc/net/tcp", "/proc/net/tcp6", check=False).splitlines()
    rows = [line.split() for line in lines if ":" in line]
    ours = (row[1].rpartition(":") for row in rows if len(row) > 3 and row[3] == _LISTENING)
    return {
        int(port, 16)
        for address, _, port in ours
        if address not in {"0100007F", "0B00007F"} and not address.endswith("01000000")
    }


def targets(system: ComposedSystem) -> dict[tuple[str, int], str]:
    """Every address and port at which a service listens, with the service's name."""
    found: dict[tuple[str, int], str] = {}
    for service in ("api", "scheduler", "worker", "rig", "postgres", "dome"):
        networks = system.inspect(system.container(service))["NetworkSettings"]["Networks"].values()
        found |= {(one["IPAddress"], port): service for one in networks for port in listening(system, service)}
    return found


def expected(service: str, port: int) -> set[str]:
    """Answers that a service may give an outsider on one of its ports."""
    if service == "api":
        return {"http 401"}
    if service == "postgres":
        return {"silent"}
    return {"silent"} if service == "dome" else {"tls refuses"}


@pytest.mark.parametrize("network", NETWORKS)
def test_a_container_on_a_network_is_let_into_nothing(system: ComposedSystem, network: str) -> None:
    aims = targets(system)
    image = system.inspect(system.container("api"))["Config"]["Image"]
    mount = ["--volume", f"{STRANGER}:/stranger.py:ro"]
    told = system.engine(
        "run",
        "--rm",
        "--network",
        system.network(network),
        *mount,
        image,
        "python",
        "/stranger.py",
        json.dumps(list(aims)),
    )
    check(aims, json.loads(told.strip().splitlines()[-1]))


def test_another_user_of_the_host_is_let_into_nothing(system: ComposedSystem) -> None:
    aims = targets(system)
    command = [PYTHON, "-c", STRANGER.read_text(), json.dumps(list(aims))]
    told = subprocess.run(
        command, user=NOBODY, group=NOBODY, extra_groups=[], capture_output=True, text=True, check=True, cwd="/"
    )
    reached = check(aims, json.loads(told.stdout))
    assert reached <= {"api", "scheduler", "worker", "rig", "postgres", "dome"}


def check(aims: dict[tuple[str, int], str], told: dict[str, str]) -> set[str]:
    """Assert that each answer is a refusal; returns the services that answered at all."""
    assert set(aims.values()) == {"api", "scheduler", "worker", "rig", "postgres", "dome"}
    for (host, port), service in aims.items():
        answer = told[f"{host}:{port}"]
        assert answer in {"closed", *expected(service, port)}, (service, port, answer)
    return {aims[host, port] for host, port in aims if told[f"{host}:{port}"] != "closed"}


def test_the_database_wants_its_password(system: ComposedSystem) -> None:
    image = system.inspect(system.container("api"))["Config"]["Image"]
    code = "import psycopg; psycopg.connect('postgresql://dentine:guess@postgres/dentine', connect_timeout=5)"
    told = system.engine(
        "run", "--rm", "--network", system.network("database"), image, "python", "-c", code, check=False
    )
    assert "password authentication failed" in told


def test_a_dask_client_without_certificate_runs_nothing(system: ComposedSystem) -> None:
    image = system.inspect(system.container("api"))["Config"]["Image"]
    for scheme in ("tcp", "tls"):
        code = f"from distributed import Client; Client('{scheme}://scheduler:8786', timeout=5)"
        told = system.engine(
            "run", "--rm", "--network", system.network("parts"), image, "python", "-c", code, check=False
        )
        assert "Error" in told.strip().splitlines()[-1]


def test_no_part_may_more_than_it_needs(system: ComposedSystem) -> None:
    for service in ("api", "scheduler", "worker", "rig", "dome", "postgres"):
        host = system.inspect(system.container(service))["HostConfig"]
        assert host["ReadonlyRootfs"], service
        assert host["CapDrop"] == ["ALL"], service
        assert any(one.startswith("no-new-privileges") for one in host["SecurityOpt"]), service
        assert host["LogConfig"]["Config"] == {"max-size": "10m", "max-file": "3"}, service
        assert host["Memory"] > 0, service
