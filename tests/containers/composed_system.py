"""The composed system in real containers, with methods by which tests start, disturb and query it.

Environment variables choose the container engine: ``DENTINE_COMPOSE`` is the compose command (``docker compose`` by
default, or ``podman-compose``), ``DENTINE_ENGINE`` the engine's command (``docker`` by default), and ``DOCKER_HOST``
the engine's address.
"""

from __future__ import annotations

import json
import os
import secrets
import shlex
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

from tests.support.live_server import connect
from tests.support.small_system import free_port

ROOT = Path(__file__).parents[2]
COMPOSE_FILES = (ROOT / "deploy" / "compose.yaml", Path(__file__).parent / "compose.override.yaml")
USER = 10001
"""User id of the images' processes."""
PATIENCE_S = 300.0
JOB = {
    "boundary": "matched",
    "dentin": "known",
    "samples_per_pixel": 16,
    "max_samples_per_pixel": 16,
    "max_steps": 1,
    "search_candidates": 100,
    "advise": False,
    "seed": 1,
}
"""Options of a fit that takes some ten seconds."""


class ComposedSystem:
    """One project of the compose file.

    Args:
        project: name of the project, the prefix of its containers, networks and volumes.
        data: folder on the host that is mounted as the data volume.
        environment: further variables of the compose commands.
    """

    def __init__(self, project: str, data: Path, **environment: str) -> None:
        self.project, self.data, self.port = project, data, free_port()
        self._engine = shlex.split(os.environ.get("DENTINE_ENGINE", "docker"))
        self._compose = shlex.split(os.environ.get("DENTINE_COMPOSE", "docker compose"))
        self.environment = os.environ | {"DENTINE_TEST_DATA": str(data), "DENTINE_PORT": str(self.port)} | environment
        self.address = f"http://127.0.0.1:{self.port}"

    def compose(self, *arguments: str, check: bool = True) -> str:
        """Run a compose command and return its output."""
        files = [part for file in COMPOSE_FILES for part in ("--file", str(file))]
        return self._run([*self._compose, "--project-name", self.project, *files, *arguments], check=check)

    def engine(self, *arguments: str, check: bool = True) -> str:
        """Run a command of the engine and return its output."""
        return self._run([*self._engine, *arguments], check=check)

    def inside(self, service: str, *command: str, check: bool = True) -> str:
        """Run a command in a service's container and return its output."""
        return self.engine("exec", self.container(service), *command, check=check)

    def container(self, service: str) -> str:
        """Name of the first container of a service."""
        return f"{self.project}-{service}-1"

    def network(self, name: str) -> str:
        """The engine's name of one of the compose file's networks."""
        return f"{self.project}_{name}"

    def inspect(self, what: str) -> dict[str, Any]:
        """The engine's description of a container or an image."""
        return dict(json.loads(self.engine("inspect", what))[0])

    def address_of(self, service: str, network: str) -> str:
        """IP address of a service's container on a network."""
        return str(
            self.inspect(self.container(service))["NetworkSettings"]["Networks"][self.network(network)]["IPAddress"]
        )

    def client(self, token: str | None = None) -> httpx.Client:
        """A client of the API, with a token if one is given."""
        client = connect(self.address)
        if token is not None:
            client.headers["Authorization"] = f"Bearer {token}"
        return client

    def up(self, *arguments: str) -> float:
        """Start all services and wait until the system is ready to run jobs; returns the time that this took, s."""
        start = time.monotonic()
        self.compose("up", "--detach", *arguments)
        self.wait_until(self.is_live, "the API does not answer")
        token = self.token("readiness", "read")
        self.wait_until(lambda: self.is_ready(token), "the system does not become ready")
        return time.monotonic() - start

    def down(self, *arguments: str) -> None:
        """Stop and remove the containers; volumes stay unless ``--volumes`` is given."""
        self.compose("down", *arguments)

    def token(self, name: str, *scopes: str) -> str:
        """Create a token whose name begins with ``name``."""
        chosen = [part for scope in scopes for part in ("--scope", scope)]
        said = self.inside("api", "dentine", "token", "create", f"{name}-{secrets.token_hex(3)}", *chosen)
        return next(line for line in said.splitlines() if line.startswith("dentine_"))

    def is_live(self) -> bool:
        """Whether the API answers at all."""
        try:
            with self.client() as client:
                return client.get("/v1/health/live").status_code == 200
        except httpx.TransportError:
            return False

    def is_ready(self, token: str) -> bool:
        """Whether the system is ready to run jobs."""
        try:
            with self.client(token) as client:
                return client.get("/v1/health/ready").status_code == 200
        except httpx.TransportError:
            return False

    def wait_until(self, condition: Callable[[], bool], complaint: str, seconds: float = PATIENCE_S) -> None:
        """Wait for a condition.

        Raises:
            AssertionError: the condition does not hold in time; the message has the last lines of all logs.
        """
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise AssertionError(f"{complaint}\n{self.compose('logs', '--tail', '15', check=False)}")
            time.sleep(0.2)

    def run_dentine(self, token: str, *arguments: str, cwd: Path) -> str:
        """Run a client command on this host and return its output."""
        environment = self.environment | {"DENTINE__CLIENT__TOKEN": token}
        command = [str(ROOT / ".venv/bin/dentine"), *arguments]
        done = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def _run(self, command: list[str], *, check: bool) -> str:
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False)
        assert not check or done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
        return done.stdout + done.stderr


def follow(client: httpx.Client, job: str, seconds: float = PATIENCE_S) -> dict[str, Any]:
    """Wait for a job's end and return the API's record of it; the API may be unreachable meanwhile."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            detail = client.get(f"/v1/jobs/{job}").json()
            if detail.get("state") in {"SUCCEEDED", "FAILED", "CANCELLED"}:
                return dict(detail)
        except (httpx.TransportError, json.JSONDecodeError):
            pass
        assert time.monotonic() < deadline, f"job {job} has not ended"
        time.sleep(0.3)
