"""After SIGKILL of a server, or of the process that drives its dome, while a light is on by hand, the dome is dark."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import psutil
import pytest

from services.capture.dome.controller import DomeObserver
from services.capture.dome.registers import FaultBit
from services.capture.dome.simulator import simulated_dome
from services.core.settings import DomeSettings, ServerSettings
from tests.support.live_server import connect

WATCHDOG_S = 1.0
SERVER = """
import sys
from services.api.server import serve
from services.core.settings import ServerSettings
serve(ServerSettings.model_validate_json(sys.argv[1]))
"""


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s, "waited for a minute in vain"
        time.sleep(0.01)


@pytest.mark.parametrize("killed", ["server", pytest.param("dome process", marks=pytest.mark.slow)])
def test_killed_under_light(tmp_path: Path, killed: str) -> None:
    with simulated_dome(6, WATCHDOG_S) as address, closing(DomeObserver(*address)) as observer:
        kill(killed, tmp_path, address, observer)


def kill(killed: str, data: Path, address: tuple[str, int], observer: DomeObserver) -> None:
    settings = ServerSettings(
        data=data, port=0, dome=DomeSettings(address=f"{address[0]}:{address[1]}", watchdog_s=WATCHDOG_S)
    )
    with subprocess.Popen(
        [sys.executable, "-c", SERVER, settings.model_dump_json()], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        with connect(process.stdout.readline().strip()) as client:
            client.put("/v1/dome/light", json={"light": 3, "on_s": 30}).raise_for_status()
            console = next(
                child
                for child in psutil.Process(process.pid).children()
                if "services.capture.console" in child.cmdline()
            )
            assert observer.status().lit == (3,)
            os.kill(process.pid if killed == "server" else console.pid, signal.SIGKILL)
            killed_s = time.monotonic()
            wait_until(lambda: observer.status().lit == ())
            if killed == "server":
                # The dome process noticed the server's death, darkened the dome itself, and ended.
                assert observer.faults() == FaultBit(0)
                console.wait(30)
            else:
                wait_until(lambda: time.monotonic() > killed_s + WATCHDOG_S)
                assert observer.status().lit == ()
                assert observer.faults() == FaultBit.WATCHDOG
                assert client.put("/v1/dome/light", json={"light": 1}).json()["lit"] == [1]
        process.terminate()
        process.wait(30)
    assert observer.status().lit == ()
