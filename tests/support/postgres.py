"""A Postgres server of the tests' own, on a socket in its data folder."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import sqlalchemy as sql

from services.api.database import open_database

USER = "postgres"
"""Who runs the server where the tests run as root, which Postgres refuses."""


@contextmanager
def postgres_server() -> Iterator[str]:
    """URL of a fresh server without its database's name; skips where Postgres is not installed."""
    found = next(iter(sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)), None)
    if found is None:
        pytest.skip("Postgres is not installed.")
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    as_user = {}
    if os.geteuid() == 0:
        if USER not in {entry.pw_name for entry in pwd.getpwall()}:
            pytest.skip(f"Postgres does not run as root, and there is no user {USER}.")
        shutil.chown(folder, USER, USER)
        as_user = {"user": USER, "group": USER, "extra_groups": []}

    def run(*command: str) -> None:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder, **as_user)

    data = folder / "data"
    try:
        run(str(found / "initdb"), "--pgdata", str(data), "--username", USER, "--auth", "trust", "--no-sync")
        options = f"-c listen_addresses= -c unix_socket_directories={folder} -c fsync=off"
        run(str(found / "pg_ctl"), "--pgdata", str(data), "--wait", "--log", str(folder / "log"), "--options", options, "start")
        try:
            yield f"postgresql://{USER}@/{{name}}?host={folder}"
        finally:
            run(str(found / "pg_ctl"), "--pgdata", str(data), "--wait", "--mode", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def new_database(server: str, name: str) -> str:
    """URL of an empty database on a server."""
    engine = open_database(server.format(name="postgres"))
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(sql.text(f'CREATE DATABASE "{name}"'))
    engine.dispose()
    return server.format(name=name)
