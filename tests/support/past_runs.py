"""A made-up history of finished jobs, so that a test knows which duration a server must forecast."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from services.api.jobs.past_runs import Course, past_run_table
from services.api.jobs.size import method_of, size_of
from services.core.records import JobSpec
from services.core.settings import DATABASE_FILE
from services.pipeline.database import open_database, sqlite_url, writing
from services.pipeline.machine_class import machine_class


def remember_runs(data: Path, capture: str, totals_s: Iterable[float]) -> None:
    """Store past runs of this capture with these total times, nearly all of it in the second half of the fit."""
    spec, engine = JobSpec(capture=Path(capture)), open_database(sqlite_url(data / DATABASE_FILE))
    size = size_of(spec)
    assert size is not None
    with writing(engine) as connection:
        for number, total_s in enumerate(totals_s):
            reached_s = {"prepare": [0.05] * 10, "fit": [0.1] * 6 + [total_s] * 4, "export": [total_s] * 10}
            course = Course.model_validate({"machine": machine_class(), "reached_s": reached_s, "total_s": total_s})
            row = {
                "job": f"past-{number}",
                "ended_s": float(number),
                "method": method_of(spec),
                "machine": machine_class(),
            }
            connection.execute(
                past_run_table.insert().values(
                    row | {"size": size.model_dump_json(), "course": course.model_dump_json()}
                )
            )
    engine.dispose()
