"""Composes what makes one server observable: the routes of job history, health, metrics and webhooks, and the request
log.
"""

from __future__ import annotations

from collections.abc import Callable

from fastapi import FastAPI

from services.api.health.metrics import build_registry
from services.api.health.readiness import Readiness
from services.api.health.routes import build_health_router
from services.api.http.request_log import RequestLog
from services.api.http.request_metrics import RequestMetrics
from services.api.http.thread_pools import ThreadPool
from services.api.jobs.history_routes import build_observe_router
from services.api.jobs.jobs import Jobs
from services.api.webhooks.address import AddressPolicy
from services.api.webhooks.deliveries import Deliveries
from services.api.webhooks.routes import build_webhook_router
from services.api.webhooks.sender import WebhookSender
from services.api.webhooks.webhooks import Webhooks
from services.core.settings import ServerSettings
from services.pipeline.dask_tls import Certificates


class Observation:
    """The observable side of one application. ``webhook_sender.run`` is to be run while the application lives.

    Args:
        database_pool: threads that query the database.
        file_pool: threads that read the files of jobs.
        certificates, workers: as in ``Readiness``.
    """

    def __init__(
        self,
        jobs: Jobs,
        settings: ServerSettings,
        database_pool: ThreadPool,
        file_pool: ThreadPool,
        certificates: Certificates | None = None,
        workers: Callable[[], str] | None = None,
    ) -> None:
        engine, policy = jobs.repository.engine, AddressPolicy(settings.private_webhooks)
        readiness = Readiness(
            engine, jobs.folder(""), jobs.is_running, jobs.free_bytes, settings.scheduler, certificates, workers
        )
        deliveries = Deliveries(engine)
        self._registry = build_registry(engine, readiness, jobs.free_bytes)
        self._routers = (
            build_observe_router(jobs, database_pool, file_pool),
            build_health_router(readiness, self._registry),
            build_webhook_router(Webhooks(engine, policy), deliveries),
        )
        self.webhook_sender = WebhookSender(deliveries, policy)

    def include_routes(self, app: FastAPI) -> None:
        """Add the routes of job history, health, metrics and webhooks to the application."""
        for router in self._routers:
            app.include_router(router)

    def watch_requests(self, app: FastAPI) -> None:
        """Log and count all requests. Call this after all other middleware is added, so that requests which that
        middleware refuses are counted too.
        """
        app.add_middleware(RequestLog, metrics=RequestMetrics(self._registry))
