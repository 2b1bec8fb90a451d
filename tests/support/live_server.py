"""A real HTTP server, in a thread of the test or as a process of its own."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import httpx
import uvicorn


def connect(address: str) -> httpx.Client:
    """A client of one server that ignores the proxies of the environment."""
    return httpx.Client(base_url=address, trust_env=False, timeout=60)


class _Telling(uvicorn.Server):
    # Sets an event once it listens.
    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.listening = threading.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.listening.set()


@contextmanager
def serving(app: Callable[..., Any]) -> Iterator[httpx.Client]:
    """Serve an application on a free loopback port for the time of the block."""
    server = _Telling(uvicorn.Config(app, port=0, log_level="critical", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        assert server.listening.wait(30)
        port = server.servers[0].sockets[0].getsockname()[1]
        with connect(f"http://127.0.0.1:{port}") as client:
            yield client
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def toy_server(
    data: Path, log: IO[str] | None = None, stages: str = "tests.support.toy_stages", **settings: Any
) -> Iterator[tuple[httpx.Client, subprocess.Popen[str]]]:
    """Run the server with a module's stages as a process of its own. At the end of the block it gets SIGTERM unless it
    has ended already; ``log`` receives its standard error.
    """
    chosen = json.dumps({"data": str(data), "port": 0} | settings)
    with running_server([sys.executable, "-m", "tests.support.toy_server", chosen, stages], log) as running:
        yield running


@contextmanager
def running_server(
    command: list[str],
    log: IO[str] | None = None,
    cwd: Path = Path(__file__).parents[2],
    environment: Mapping[str, str] | None = None,
) -> Iterator[tuple[httpx.Client, subprocess.Popen[str]]]:
    """Run a server as a process of its own, which prints its address in its first line of output."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=cwd, env=environment) as process:
        try:
            assert process.stdout is not None
            with connect(process.stdout.readline().strip()) as client:
                yield client, process
        finally:
            if process.poll() is None:
                process.terminate()
                assert process.wait(300) == 0
