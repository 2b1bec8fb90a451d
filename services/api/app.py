"""The ASGI application of the server, built from settings that are passed in."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from services.api.jobs.jobs import Jobs
from services.api.jobs.runner import RunJob
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageName
from services.pipeline.dask_tls import Certificates
from services.pipeline.event_log import EventAddress
from services.pipeline.stages import DOORS, first_stage, run_job
from services.pipeline.workers import Workers

if TYPE_CHECKING:
    from fastapi import FastAPI

PHANTOMS = "phantoms"
"""Folder below the data folder for the virtual mouths of demonstrations. Each mouth is rendered once, and one that is
removed is rendered again."""
STATIC = Path(__file__).parent / "dashboard" / "static"
ALL_OFF_THREADS = 8
"""Number of threads that only carry out ALL OFF, so that no other request that hangs can delay it. As many ALL OFF
requests can run at once."""
CANCEL_THREADS = 4
"""Number of threads that cancel jobs. They are separate from the threads of ALL OFF because each may wait for the
database, which ALL OFF does only once the dome is dark."""
DOME_THREADS = 8
"""Number of threads that read the state of a dome, switch single lights and run preflights. A dome that does not answer
holds a thread for half a minute, during a preflight for five minutes."""
UNBUILT = STATIC.with_name("unbuilt")
"""Folder of the page that says how to build the dashboard. It is served where the dashboard is not built."""


def is_dashboard_built() -> bool:
    """Whether this installation contains the built dashboard."""
    return (STATIC / "app.js").exists()


def create_app(settings: ServerSettings, run: RunJob | None = None, doors: Mapping[StageName, str] = DOORS) -> FastAPI:
    """Build the application that serves the data folder ``settings.data``. Jobs run while its lifespan is active.

    ``app.state.darken`` of the result asks everything that lights a dome to stop. It can be called from any thread and
    waits for nothing else.

    Args:
        run: function that runs one job; it replaces the stages and their workers.
        doors: ``module:function`` of stages that are entered elsewhere than a job's kind says.

    Raises:
        SettingsError: access is open and the address is not loopback, or the database belongs to another data folder.
    """
    from fastapi import FastAPI
    from starlette.staticfiles import StaticFiles

    from services.api.auth.access import refuse_open_network
    from services.api.auth.browser_protection import BrowserProtection
    from services.api.auth.install import install
    from services.api.captures.routes import build_captures_router
    from services.api.dome.dome import Dome
    from services.api.dome.routes import build_dome_router
    from services.api.health.worker_routes import build_workers_router
    from services.api.http import problems
    from services.api.http.thread_pools import ThreadPool
    from services.api.jobs.calibration_routes import build_calibrations_router
    from services.api.jobs.event_stream import EventBroadcaster
    from services.api.jobs.routes import build_router
    from services.api.masks.masks import Masks
    from services.api.masks.routes import build_masks_router
    from services.api.observation import Observation

    refuse_open_network(settings)
    certificates = Certificates.of(settings.tls) if settings.tls is not None else None
    workers = Workers(settings.scheduler, certificates)

    def run_on_workers(spec: JobSpec, folder: Path, events: EventAddress) -> None:
        phantoms = settings.data.resolve() / PHANTOMS
        run_job(
            spec,
            folder,
            events=events,
            doors=doors,
            cluster=workers,
            is_logged=True,
            before=lambda: jobs.require_slot(events.job),
            phantoms=phantoms,
            is_cancelled=lambda: jobs.is_cancelled(events.job),
        )

    def run_with_dome(spec: JobSpec, folder: Path, events: EventAddress) -> None:
        if first_stage(spec, folder) == "capture":
            dome.yield_to_capture()
        (run or run_on_workers)(spec, folder, events)

    jobs = Jobs(settings, run_with_dome, workers.reason_unavailable if run is None else lambda _: None)
    dome = Dome(settings.dome, jobs)

    def darken() -> None:
        try:
            jobs.stop()
        finally:
            dome.close()

    database_pool, file_pool, capture_pool, audit_pool = (
        ThreadPool.for_database(jobs.repository.engine),
        ThreadPool(1),
        ThreadPool(1),
        ThreadPool(1),
    )
    parser_pool = ThreadPool(1)
    # ALL OFF runs in threads that nothing else uses, and the audit rows of all requests that darken a dome are written
    # by a thread of their own. Reading the state of a dome and switching its lights have their own threads too.
    all_off_pool, dark_audit_pool = ThreadPool(ALL_OFF_THREADS), ThreadPool(1)
    cancel_pool, dome_pool = ThreadPool(CANCEL_THREADS), ThreadPool(DOME_THREADS)
    broadcaster = EventBroadcaster(jobs.repository, database_pool.run, settings.connections)
    observation = Observation(
        jobs, settings, database_pool, file_pool, certificates, None if run else workers.condition
    )

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        dome.start()
        if run is None and doors is DOORS:  # the check covers the packages of the standard stages alone
            workers.begin_check()
        jobs.start()
        tasks = [asyncio.create_task(broadcaster.run()), asyncio.create_task(observation.webhook_sender.run())]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            closing_pool = ThreadPool(1)  # a new thread, as all others may hang; the dome goes dark first
            pools = (
                all_off_pool,
                cancel_pool,
                database_pool,
                file_pool,
                capture_pool,
                audit_pool,
                dark_audit_pool,
                dome_pool,
                parser_pool,
            )
            for close in (darken, *(pool.close for pool in pools), jobs.close, workers.close):
                await closing_pool.run(close)

    app = FastAPI(
        title="dentine", version=version("dentine"), lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None
    )
    app.state.darken, app.state.parser_pool = darken, parser_pool
    problems.install(app)
    app.include_router(build_router(jobs, broadcaster, database_pool, file_pool, capture_pool, cancel_pool))
    app.include_router(build_captures_router(jobs.captures))
    app.include_router(build_calibrations_router(jobs.calibrations, jobs.captures, jobs, file_pool))
    app.include_router(build_masks_router(jobs, Masks(jobs)))
    app.include_router(build_dome_router(dome, all_off_pool, dome_pool))
    app.include_router(build_workers_router(workers, jobs.repository))
    observation.include_routes(app)
    install(app, settings, jobs.repository.engine, audit_pool, dark_audit_pool)
    app.mount("/", StaticFiles(directory=STATIC if is_dashboard_built() else UNBUILT, html=True), name="dashboard")
    names = {
        "127.0.0.1",
        "localhost",
        "::1",
        settings.host,
        urlsplit(settings.public_url or "").hostname or "",
        *settings.names.split(","),
    } - {""}
    app.add_middleware(BrowserProtection, names=names, secure=not settings.is_loopback)
    observation.watch_requests(app)
    return app
