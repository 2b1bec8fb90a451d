"""Metrics for Prometheus, in a registry of the application's own.

Labels take only values that the program itself defines.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, get_args

import sqlalchemy as sql
from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from services.api.health.readiness import Readiness
from services.api.tables.jobs import job_table
from services.api.tables.lifecycle import JobState
from services.api.tables.webhooks import DeliveryState, delivery_table
from services.core.stage import StageName
from services.pipeline.event_log import event_table

STAGES: tuple[StageName, ...] = get_args(StageName)


def build_registry(engine: sql.Engine, readiness: Readiness, free_bytes: Callable[[], int]) -> CollectorRegistry:
    """Build the registry of one server; the metrics of requests are added by ``RequestMetrics``."""
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    registry.register(ServiceCollector(engine, readiness, free_bytes))
    return registry


class ServiceCollector(Collector):
    """Collects the metrics of jobs from the database at every scrape, in a few queries on indices. Where the database
    is down, it reports that instead of failing.
    """

    def __init__(self, engine: sql.Engine, readiness: Readiness, free_bytes: Callable[[], int]) -> None:
        self._engine, self._readiness, self._free_bytes = engine, readiness, free_bytes
        self._counting = threading.Lock()
        self._steps, self._counted_to = 0, self._newest_event()

    def collect(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        """Yield all families of metrics."""
        checks = self._readiness.checks()
        yield _gauge("dentine_up", "1 where the part works", "part", ((check.name, check.ok) for check in checks))
        ok = {check.name: check.ok for check in checks}
        with suppress(OSError):
            yield GaugeMetricFamily("dentine_disk_free_bytes", "Free space where jobs are stored", self._free_bytes())
        if ok["database"]:
            with suppress(sql.exc.SQLAlchemyError):  # the database went down since the check
                yield from self._of_database()

    def _of_database(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        with self._engine.connect() as connection:
            by_state = _counts(connection, sql.select(job_table.c.state, sql.func.count()).group_by(job_table.c.state))
            queued_s = connection.scalar(
                sql.select(sql.func.min(job_table.c.changed_s)).where(job_table.c.state == JobState.QUEUED)
            )
            running = _counts(connection, _running_stages())
            rows = connection.scalar(sql.select(sql.func.count()).select_from(event_table)) or 0
            deliveries = _counts(
                connection, sql.select(delivery_table.c.state, sql.func.count()).group_by(delivery_table.c.state)
            )
        yield _gauge("dentine_jobs", "Jobs by state", "state", ((state, by_state.get(state, 0)) for state in JobState))
        age_s = 0.0 if queued_s is None else max(time.time() - queued_s, 0.0)
        yield GaugeMetricFamily(
            "dentine_oldest_queued_job_seconds", "How long the oldest queued job has waited; 0 without one", age_s
        )
        yield _gauge(
            "dentine_stages_running", "Running stages", "stage", ((stage, running.get(stage, 0)) for stage in STAGES)
        )
        yield GaugeMetricFamily("dentine_event_rows", "Rows of the event table", rows)
        states = ((state, deliveries.get(state, 0)) for state in DeliveryState)
        yield _gauge("dentine_webhook_deliveries", "Webhook deliveries in the log by state", "state", states)
        yield CounterMetricFamily(
            "dentine_steps", "Steps that fits have taken since this server started", self._count_steps()
        )

    def _count_steps(self) -> int:
        """Return how many steps fits have taken since this server started; only rows since the last scrape are read."""
        with self._counting, self._engine.connect() as connection:
            newest = connection.scalar(sql.select(sql.func.max(event_table.c.id))) or 0
            fresh = event_table.c.id.between(self._counted_to + 1, newest)
            self._steps += (
                connection.scalar(sql.select(sql.func.count()).where(fresh, event_table.c.kind == "step")) or 0
            )
            self._counted_to = newest
            return self._steps

    def _newest_event(self) -> int:
        with self._engine.connect() as connection:
            return connection.scalar(sql.select(sql.func.max(event_table.c.id))) or 0


def _counts(connection: sql.Connection, query: sql.Select[Any]) -> dict[str, int]:
    return {row[0]: row[1] for row in connection.execute(query)}


def _running_stages() -> sql.Select[Any]:
    """Build the query of how many jobs are in each stage, from the last event with a stage of each job that runs."""
    of_job = event_table.alias()
    last = (
        sql.select(of_job.c.id)
        .where(of_job.c.job == job_table.c.id, of_job.c.stage.is_not(None))
        .order_by(of_job.c.id.desc())
        .limit(1)
        .correlate(job_table)
        .scalar_subquery()
    )
    return (
        sql.select(event_table.c.stage, sql.func.count())
        .join_from(job_table, event_table, event_table.c.id == last)
        .where(job_table.c.state.in_((JobState.RUNNING, JobState.CANCELLING)), event_table.c.kind != "finished")
        .group_by(event_table.c.stage)
    )


def _gauge(name: str, text: str, label: str, values: Iterable[tuple[str, float]]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, text, labels=(label,))
    for value, number in values:
        family.add_metric((value,), float(number))
    return family
