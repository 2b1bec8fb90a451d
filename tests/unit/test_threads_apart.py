"""Looking up a token or a host name does not wait for threads that hang in other work."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import HTTPConnection

from services.api.auth.access import Access
from services.api.auth.sessions import Sessions
from services.api.auth.tokens import Scope, Tokens
from services.api.webhooks.address import AddressPolicy
from services.core.settings import ServerSettings
from services.pipeline.database import open_database
from tests.support.guarded_server import make_token


@asynccontextmanager
async def every_thread_hanging() -> AsyncIterator[None]:
    """All threads of the common pool hang for the time of the block."""
    goes_on = threading.Event()
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
    hanging = asyncio.create_task(asyncio.to_thread(goes_on.wait, 60))
    await asyncio.sleep(0)
    try:
        async with asyncio.timeout(10):
            yield
    finally:
        goes_on.set()
        await hanging


def test_tokens_and_sessions_are_looked_up_while_other_work_hangs(tmp_path: Path) -> None:
    secret = make_token(tmp_path, "reader", Scope.READ)
    engine = open_database(ServerSettings(data=tmp_path).database_url)
    sessions = Sessions(b"key", 3600.0)
    cookie, _ = sessions.issue(Tokens(engine).authenticate(secret))
    access = Access(Tokens(engine), sessions)

    async def ask() -> list[str]:
        headers = [(b"authorization", f"Bearer {secret}".encode())], [(b"cookie", f"dentine-session={cookie}".encode())]
        async with every_thread_hanging():
            return [(await access.identify(HTTPConnection({"type": "http", "headers": one}))).name for one in headers]

    assert asyncio.run(ask()) == ["reader"] * 2
    engine.dispose()


def test_a_webhooks_name_is_looked_up_while_other_work_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    def getaddrinfo(*_: Any, **__: Any) -> list[Any]:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("93.184.216.34", 443))]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)

    async def ask() -> list[str]:
        async with every_thread_hanging():
            return await AddressPolicy().resolve("some.example", 443, "https")

    assert asyncio.run(ask()) == ["93.184.216.34"]
