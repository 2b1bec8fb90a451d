"""A server that accepts uploads, and one upload that has begun."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from services.api.auth.install import install
from services.api.captures.captures import Captures
from services.api.captures.routes import build_captures_router
from services.api.http import problems
from services.api.http.thread_pools import ThreadPool
from services.core.settings import ServerSettings, UploadLimits
from tests.support.live_server import serving
from tests.support.tus_world import CONTENT, CONTENTS, World
from tests.support.uploading import announce, create_upload, upgraded


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def client(tmp_path: Path, world: World) -> Iterator[httpx.Client]:
    engine = upgraded(tmp_path / "db.sqlite")
    limits = UploadLimits(open_for_s=100, silence_s=2, keep_free_bytes=10)
    app = FastAPI()
    app.state.parser_pool = ThreadPool(1)
    problems.install(app)
    captures = Captures(engine, tmp_path, limits, lambda: world.now_s, lambda: world.free_bytes, world.write)
    app.include_router(build_captures_router(captures))
    install(app, ServerSettings(data=tmp_path), engine, ThreadPool(1), ThreadPool(1))
    with serving(app) as connected:
        yield connected
    engine.dispose()


@pytest.fixture
def upload(client: httpx.Client) -> str:
    return create_upload(client, announce(client, CONTENTS)["id"], "a.npy", CONTENT)
