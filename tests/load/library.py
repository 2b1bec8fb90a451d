"""What a laboratory has in its data folder after a while: jobs that have ended, some with long curves and files."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from services.api.jobs.repository import Repository
from services.api.tables.lifecycle import Trigger
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from services.pipeline.database import writing
from services.pipeline.event_log import insert_event
from tests.support.uploading import write_capture

PICTURE_BYTES = 2**18
STEPS = 500
PICTURE_EVERY = 25


@dataclass(frozen=True)
class Library:
    """Ended jobs, oldest first; those in ``fitted`` have a curve of 500 steps and files."""

    capture: Path
    jobs: Sequence[str]
    fitted: Sequence[str]
    last_event: int
    """Of the last fitted job."""


def fill(data: Path, capture: Path, jobs: int, fitted: int) -> Library:
    """Write the library into the data folder of a server that does not run."""
    if not capture.exists():
        write_capture(capture)
    data.mkdir(parents=True, exist_ok=True)
    repository = Repository(ServerSettings(data=data).database_url)
    try:
        ids = [_ended(repository, JobSpec(capture=capture, seed=seed)) for seed in range(jobs)]
        with_curve = ids[-fitted:]
        for job in with_curve:
            _fit(repository, job, data / "jobs" / job)
        return Library(capture, ids, with_curve, repository.events_of(with_curve[-1]).newest_id())
    finally:
        repository.close()


def _ended(repository: Repository, spec: JobSpec) -> str:
    job = repository.create(spec, key=None).job.id
    repository.settle(repository.lease(job, "library", 60.0), Trigger.SUCCEED)
    return job


def _fit(repository: Repository, job: str, folder: Path) -> None:
    (folder / "previews").mkdir(parents=True)
    (folder / "report.html").write_text("<!doctype html><title>report</title>")
    with writing(repository.engine) as connection:
        insert_event(connection, job, 1, StageEvent(stage="fit", kind="started"))
        for step in range(1, STEPS + 1):
            curve = {
                "loss": 0.99**step,
                "fit_error": 0.9,
                "held_out_error": 0.99**step,
                "held_out_se": 0.01,
                "samples": 64,
            }
            parameters = {
                f"{part}.{name}": 0.1 * step for part in ("enamel", "dentin") for name in ("sigma", "albedo", "g")
            }
            data = {"channel": "green", "step": step, "stage": "media", "parameters": parameters} | curve
            insert_event(
                connection,
                job,
                1,
                StageEvent(stage="fit", kind="step", message=f"Step {step}.", done=step / STEPS, data=data),
            )
            if step % PICTURE_EVERY == 0:
                path = f"previews/green-{step:03d}-c0-l1-render.png"
                (folder / path).write_bytes(secrets.token_bytes(PICTURE_BYTES))
                picture = {
                    "camera": "c0",
                    "light": "l1",
                    "held_out": False,
                    "channel": "green",
                    "step": step,
                    "render": path,
                }
                insert_event(connection, job, 1, StageEvent(stage="fit", kind="preview", data=picture))
                insert_event(connection, job, 1, StageEvent(stage="fit", kind="log", message=f"Step {step} is done."))
        insert_event(connection, job, 1, StageEvent(stage="fit", kind="finished", done=1.0))
