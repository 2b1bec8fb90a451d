"""``python -m tests.support.engine_server SETTINGS``: the real server with a fit that calls an engine, and with a known
memory limit for its worker.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from services.core.settings import ServerSettings
from tests.support.live_server import running_server
from tests.support.toy_server import main

MIB = 2**20
MEMORY_BYTES = 1200 * MIB


@contextmanager
def engine_server(data: Path) -> Iterator[tuple[httpx.Client, subprocess.Popen[str]]]:
    """Run this module's server as a process of its own for the time of the block."""
    with running_server(
        [sys.executable, "-m", "tests.support.engine_server", json.dumps({"data": str(data), "port": 0})]
    ) as running:
        yield running


if __name__ == "__main__":
    resource.setrlimit(
        resource.RLIMIT_RSS, (MEMORY_BYTES, MEMORY_BYTES)
    )  # the kernel does not enforce this limit; Dask reads it and divides it among the processors
    main(ServerSettings.model_validate_json(sys.argv[1]), "tests.support.engine_stages")
