"""The ASGI application; everything it needs is given to it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from services.api.events import EventAddress
from services.api.jobs import Jobs, RunJob
from services.api.pipeline import run_job
from services.core.records import JobSpec
from services.core.settings import ServerSettings

if TYPE_CHECKING:
    from fastapi import FastAPI

STATIC = Path(__file__).parent / "dashboard" / "static"


def run_locally(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Run a job on this machine's own workers."""
    run_job(spec, folder, events=events)


def create_app(settings: ServerSettings, run: RunJob = run_locally) -> FastAPI:
    """Build the application over ``settings.data``; its lifespan frames the time in which jobs run."""
    from fastapi import FastAPI
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.staticfiles import StaticFiles

    from services.api import problems
    from services.api.captures_routes import build_captures_router
    from services.api.feed import EventFeed
    from services.api.routes import build_router
    from services.api.shield import Shield

    jobs = Jobs(settings.data, run, settings.uploads)
    feed = EventFeed(jobs.repository.newest_event)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        jobs.start()
        following = asyncio.create_task(feed.run())
        try:
            yield
        finally:
            following.cancel()
            with suppress(asyncio.CancelledError):
                await following
            await asyncio.to_thread(jobs.close)

    app = FastAPI(title="dentine", version=version("dentine"), lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url="/v1/openapi.json")
    problems.install(app)
    app.include_router(build_router(jobs, feed))
    app.include_router(build_captures_router(jobs.captures))
    app.mount("/", StaticFiles(directory=STATIC, html=True), name="dashboard")
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=sorted({"127.0.0.1", "localhost", "[::1]", settings.host}))
    app.add_middleware(Shield)
    return app
