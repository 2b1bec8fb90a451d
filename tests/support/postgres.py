"""A temporary Postgres server for tests, reached by a socket in its own folder or as a host of a test's network."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
import sqlalchemy as sql

from services.pipeline.database import open_database
from tests.support.network import Network

USER = "postgres"
"""System user that runs the server when the tests run as root, because Postgres refuses to run as root."""


class PostgresServer:
    """A server in a temporary folder that can be killed and started again. The test is skipped where Postgres is not
    installed.

    Args:
        network: network in which the server is the host ``database``; None for a server with only a socket.
    """

    def __init__(self, network: Network | None = None) -> None:
        found = next(iter(sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)), None)
        if found is None:
            pytest.skip("Postgres is not installed.")
        self._as_user: dict[str, Any] = {}
        if os.geteuid() == 0:
            if USER not in {entry.pw_name for entry in pwd.getpwall()}:
                pytest.skip(f"Postgres does not run as root, and there is no user {USER}.")
            self._as_user = {"user": USER, "group": USER, "extra_groups": []}
        self._programs, self._folder = found, Path(tempfile.mkdtemp(prefix="pg-"))
        if self._as_user:
            shutil.chown(self._folder, USER, USER)
        self._data = self._folder / "data"
        self._inside, self._address = (network.inside("database"), network.address("database")) if network else ([], "")
        self._run("initdb", "--username", USER, "--auth", "trust", "--no-sync")
        with (self._data / "pg_hba.conf").open("a") as rules:
            rules.write("host all all all trust\n")

    def url(self, name: str) -> str:
        """URL of one of the server's databases."""
        return f"postgresql://{USER}@/{name}?host={self._address or self._folder}"

    def start(self) -> None:
        """Start the server; also possible after ``kill``."""
        options = f"-c listen_addresses={self._address} -c unix_socket_directories={self._folder} -c fsync=off"
        self._run("pg_ctl", "--wait", "--log", str(self._folder / "log"), "--options", options, "start")

    def kill(self) -> None:
        """Kill the server and all its child processes by SIGKILL."""
        main = psutil.Process(int((self._data / "postmaster.pid").read_text().split()[0]))
        for process in [main, *main.children(recursive=True)]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs([main], timeout=30)

    def remove(self) -> None:
        """Stop the server and remove its folder."""
        with suppress(subprocess.CalledProcessError):
            self._run("pg_ctl", "--wait", "--mode", "immediate", "stop")
        shutil.rmtree(self._folder, ignore_errors=True)

    def _run(self, program: str, *arguments: str) -> None:
        command, options = [str(self._programs / program), "--pgdata", str(self._data), *arguments], self._as_user
        if self._inside:  # entering a network namespace needs root, so the user is changed inside it
            command, options = (
                [*self._inside, "setpriv", "--reuid", USER, "--regid", USER, "--clear-groups", *command],
                {},
            )
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=self._folder, **options)


@contextmanager
def postgres_server(network: Network | None = None) -> Iterator[PostgresServer]:
    """Run a server for the time of the block, and remove it at the end."""
    server = PostgresServer(network)
    try:
        server.start()
        yield server
    finally:
        server.remove()


def new_database(server: PostgresServer, name: str, like: str = "template1") -> str:
    """Create a database on a server; returns its URL.

    Args:
        like: database that is copied, to which nobody is connected. That of Postgres itself is empty.
    """
    engine = open_database(server.url("postgres"))
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(sql.text(f'CREATE DATABASE "{name}" TEMPLATE "{like}"'))
    engine.dispose()
    return server.url(name)
