"""Scraped metrics agree with the events, have a bounded number of series, and need few queries."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from services.api.app import create_app
from services.api.health.metrics import build_registry
from services.api.health.readiness import Readiness
from services.api.jobs.jobs import Jobs
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.pipeline.event_log import EventAddress
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving
from tests.support.telling_job import STEPS, tell

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scrape(client: Any) -> Samples:
    answer = client.get("/v1/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    families = text_string_to_metric_families(answer.text)
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in families
        for sample in family.samples
    }


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples[name, frozenset(labels.items())]


def test_jobs_steps_and_requests_are_counted(tmp_path: Path) -> None:
    entered, go_on = threading.Event(), threading.Event()

    def run(spec: JobSpec, folder: Path, events: EventAddress) -> None:
        tell(spec, folder, events)
        entered.set()
        assert go_on.wait(60)

    with serving(create_app(ServerSettings(data=tmp_path, jobs_at_once=1), run)) as client:
        assert value(scrape(client), "dentine_steps_total") == 0
        first, second = (client.post("/v1/jobs", json={"capture": "/"}).json()["id"] for _ in range(2))
        assert entered.wait(60)
        samples = scrape(client)
        assert [
            value(samples, "dentine_jobs", state=state) for state in ("RUNNING", "QUEUED", "SUCCEEDED", "FAILED")
        ] == [1, 1, 0, 0]
        assert [
            value(samples, "dentine_stages_running", stage=stage) for stage in ("capture", "prepare", "fit", "export")
        ] == [0, 0, 1, 0]
        assert value(samples, "dentine_steps_total") == STEPS + 1
        assert value(samples, "dentine_oldest_queued_job_seconds") > 0
        assert value(samples, "dentine_disk_free_bytes") > 0
        assert value(samples, "dentine_requests_total", method="POST", route="/v1/jobs", status="2xx") == 2
        assert value(samples, "dentine_request_latency_seconds_count", method="POST", route="/v1/jobs") == 2
        assert {
            part: value(samples, "dentine_up", part=part) for part in ("database", "scheduler", "store", "disk")
        } == dict.fromkeys(("database", "scheduler", "store", "disk"), 1.0)
        go_on.set()
        for job in (first, second):
            client.get(f"/v1/jobs/{job}/events")
        samples = scrape(client)
        assert value(samples, "dentine_jobs", state="SUCCEEDED") == 2
        assert value(samples, "dentine_stages_running", stage="fit") == 0
        assert value(samples, "dentine_oldest_queued_job_seconds") == 0
        assert value(samples, "dentine_steps_total") == 2 * (STEPS + 1)
        events = [
            sum(line.startswith("id: ") for line in client.get(f"/v1/jobs/{job}/events").text.splitlines())
            for job in (first, second)
        ]
        assert value(samples, "dentine_event_rows") == sum(events)


def test_strangers_cannot_make_series(tmp_path: Path) -> None:
    with serving(create_app(ServerSettings(data=tmp_path), run_nothing)) as client:
        client.get("/v1/health/live")
        scrape(client)
        client.get("/v1/nothing")
        client.request("BREW", "/v1/jobs")
        before = len(scrape(client))
        for number in range(50):
            client.get(f"/v1/nothing/{number}")
            client.get(f"/page-{number}.html")
            client.request(f"BREW{number}", "/v1/jobs")
            client.get("/v1/health/live", headers={"Host": f"{number}.example"})
        assert len(scrape(client)) <= before + 3
        assert "BREW" not in client.get("/v1/metrics").text


def test_a_scrape_is_eight_queries_however_many_jobs_there_are(tmp_path: Path) -> None:
    jobs = Jobs(ServerSettings(data=tmp_path), tell)
    engine = jobs.repository.engine
    registry = build_registry(
        engine, Readiness(engine, jobs.folder(""), jobs.is_running, jobs.free_bytes), jobs.free_bytes
    )
    asked: list[str] = []

    @sql.event.listens_for(engine, "before_cursor_execute")
    def _count(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        asked.append(statement)

    counts = []
    for _ in range(3):
        for _ in range(10):
            job = jobs.submit(JobSpec(capture=Path("/"))).job
            tell(job.spec, jobs.folder(job.id), jobs.repository.address_of(jobs.repository.lease(job.id, "me", 60)))
        asked.clear()
        assert b"dentine_event_rows" in generate_latest(registry)
        counts.append(sum(statement.startswith("SELECT") for statement in asked))
    jobs.close()
    assert counts == [8, 8, 8]
