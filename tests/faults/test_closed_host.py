"""A server's own workers on loopback run nothing for other users of the machine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil

from services.api.workers import Workers

NOBODY = 65534
PYTHON = shutil.which("python3", path=os.defpath) or sys.executable
"""The system's, as another user may not enter the folder of this one."""
OTHER_USER: dict[str, Any] = {} if os.geteuid() else {"user": NOBODY, "group": NOBODY, "extra_groups": []}
"""Only the superuser can be somebody else; for others the test asks as the same user, who is refused likewise."""
STRANGER = Path(__file__).parents[1] / "containers" / "stranger.py"


def listening() -> set[int]:
    """Ports on which this process and what it started listen."""
    here = psutil.Process()
    those = [here, *here.children(recursive=True)]
    return {one.laddr.port for process in those for one in process.net_connections("tcp") if one.status == psutil.CONN_LISTEN}


def test_whoever_shows_no_certificate_is_refused_on_every_port() -> None:
    before = listening()
    with Workers() as workers, workers.serving(2) as client:
        assert client.submit(sum, [1, 2]).result(timeout=60) == 3
        opened = listening() - before
        assert len(opened) >= 3  # scheduler and two workers
        targets = json.dumps([["127.0.0.1", port] for port in opened])
        told = subprocess.run([PYTHON, "-c", STRANGER.read_text(), targets], capture_output=True, text=True, check=True, cwd="/", **OTHER_USER)
        assert set(json.loads(told.stdout).values()) == {"tls refuses"}, told.stdout
