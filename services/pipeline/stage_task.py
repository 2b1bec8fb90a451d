"""One stage of a job, as the task that a worker runs."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sqlalchemy.exc import DBAPIError

from services.core.errors import PlatformError
from services.core.records import JobSpec
from services.core.stage import LocalContext, StageEvent, StageName
from services.core.store import is_published, translate_disk_errors
from services.pipeline.database import retry_while_lost
from services.pipeline.event_log import EventAddress
from services.pipeline.machine_class import machine_class

T = TypeVar("T")
PUBLISHED_AS = {
    "phantom": "phantom",
    "capture": "capture",
    "register": "registered",
    "prepare": "prepared",
    "fit": "fit",
    "export": "asset",
}
"""Stage -> name of the folder that it publishes within the job's folder."""
_EXTRAS = {
    "phantom": "fit",
    "capture": "capture",
    "register": "calibrate",
    "prepare": "preprocess",
    "fit": "fit",
    "export": "fit",
}
"""Stage -> extra of the distribution that a worker needs to run it."""


@dataclass(frozen=True)
class StageTask:
    """A task that runs one stage on a worker, with everything that the worker needs for it."""

    stage: StageName
    door: str
    spec: JobSpec
    root: Path
    events: EventAddress
    again: bool = False
    is_logged: bool = False

    def __call__(self) -> str:
        """Run the stage, unless a worker has published it and then died; return the stage's name."""
        folder = PUBLISHED_AS[self.stage]
        if is_published(self.root, folder) and not self.again:
            return self.stage
        with self.events.open() as log:
            lease = self.root / f"{folder}.lease"
            known, machine = int(lease.read_text()) if lease.exists() else 0, machine_class()
            attempt = self._record(lambda: log.begin_stage(self.stage, known, machine))
            reported_kinds: set[str] = set()

            def report(event: StageEvent) -> None:
                if event.kind != "started":  # begin_stage has recorded it
                    self._record(lambda: log.append(attempt, event))
                reported_kinds.add(event.kind)
                write_line(event)

            with self._logs(attempt) as write_line:
                context = LocalContext(self.root, attempt, report)
                context.raise_if_cancelled()
                module, function = self.door.split(":")
                with translate_disk_errors(self.root), _translate_missing_package(self.stage):
                    getattr(importlib.import_module(module), function)(self.spec, context)
                if "finished" not in reported_kinds:
                    report(StageEvent(stage=self.stage, kind="finished", done=1.0))
        return self.stage

    def _record(self, write: Callable[[], T]) -> T:
        """Write to the event table, and wait while it takes no writes, unless the job is cancelled meanwhile."""

        def write_unless_cancelled() -> T:
            try:
                return write()
            except DBAPIError:
                LocalContext(self.root, 0).raise_if_cancelled()
                raise

        return retry_while_lost(write_unless_cancelled)

    def _logs(self, attempt: int) -> AbstractContextManager[Callable[[StageEvent], None]]:
        """A context that logs the stage's events in the worker, or does nothing."""
        if not self.is_logged:
            return nullcontext(lambda _event: None)
        from services.pipeline.logs import stage_logs

        return stage_logs(self.stage, attempt, self.events)


@contextmanager
def _translate_missing_package(stage: StageName) -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as problem:
        if (problem.name or "services").partition(".")[0] == "services":
            raise
        extra = _EXTRAS[stage]
        what = (
            f"Stage {stage} needs {problem.name}, which its workers do not have; install dentine[{extra}] where they"
            " run, then retry the job."
        )
        raise PlatformError(what) from problem
