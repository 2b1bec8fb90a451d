"""What can be done with jobs, and the thread that runs them one after the other."""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from services.api.captures import Captures, is_uploaded
from services.api.events import EventAddress, JobEvent
from services.api.lifecycle import Instruction, JobState, Trigger
from services.api.pipeline import request_cancel, stages_of, withdraw_cancel
from services.api.repository import Creation, Failure, Job, Repository
from services.core.errors import DentineError, JobCancelledError, JobStateError, SettingsError
from services.core.geometry import Record
from services.core.records import JobSpec
from services.core.settings import UploadLimits
from services.core.stage import StageName

RunJob = Callable[[JobSpec, Path, EventAddress], object]
"""Runs a job in a folder to its end, events to the given table; raises what a stage raises."""

DATABASE_FILE = "dentine.sqlite"


class StageProgress(Record):
    """How far one stage of a job is."""

    stage: StageName
    state: str = Field(description="waiting, running, finished, or stopped where the job ended in it")
    attempt: int = Field(description="0 before the first")
    done: float = Field(description="fraction, 0 to 1")
    message: str


class Jobs:
    """Use-cases over one data folder; ``start`` and ``close`` frame the time in which jobs run."""

    def __init__(self, data: Path, run: RunJob, uploads: UploadLimits | None = None) -> None:
        self._data, self._run = data.resolve(), run
        self.repository = Repository(self._data / DATABASE_FILE)
        self.captures = Captures(self.repository.engine, self._data, uploads or UploadLimits())
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run_queued, name="jobs")

    def start(self) -> None:
        """Queue again what an earlier server left unfinished, then run jobs."""
        self.repository.lose_unfinished()
        self._wake.set()
        self._thread.start()

    def close(self) -> None:
        """Stop the running job cooperatively; it stays queued and resumes when the server starts again."""
        self._closing = True
        self._wake.set()
        for job in self.repository.page(1, state=JobState.RUNNING):
            request_cancel(self.folder(job.id))
        if self._thread.ident is not None:
            self._thread.join()
        self.repository.close()

    def folder(self, job_id: str) -> Path:
        """Where a job's stages and results lie."""
        return self._data / "jobs" / job_id

    def submit(self, spec: JobSpec, key: str | None = None) -> Creation:
        """Queue a job.

        Raises:
            SettingsError: a path is relative or absent, or an uploaded capture is not committed. JobStateError: the key belongs to another job.
        """
        for option, path in (("capture", spec.capture), ("rig.mouth", spec.rig.mouth if spec.rig else None)):
            if path is not None and not path.is_absolute() and not (option == "capture" and is_uploaded(path)):
                raise SettingsError(f"Option '{option}': {path} is relative; give the absolute path on the server.")
            if path is not None and path.is_absolute() and not path.exists():
                raise SettingsError(f"Option '{option}': {path} does not exist on the server; check the path.")
        with self.captures.keeping(spec.capture):
            creation = self.repository.create(spec, key)
        self._wake.set()
        return creation

    def cancel(self, job_id: str) -> Job:
        """Cancel a job; a running one stops between two frames or steps.

        Raises:
            UnknownJobError: there is no such job. JobStateError: it has ended.
        """
        if self.repository.apply(job_id, Trigger.CANCEL).instruction is Instruction.STOP:
            request_cancel(self.folder(job_id))
        return self.repository.get(job_id)

    def retry(self, job_id: str) -> Job:
        """Queue a failed or cancelled job again; it resumes from what it had published."""
        self.repository.apply(job_id, Trigger.RETRY)
        self._wake.set()
        return self.repository.get(job_id)

    def progress(self, job: Job) -> list[StageProgress]:
        """How far each stage is, from the event table."""
        latest = {event.stage: event for event in self.repository.events_of(job.id).latest()}
        return [_stage_progress(job, stage, latest.get(stage)) for stage in stages_of(job.spec)]

    def free_bytes(self) -> int:
        """Free space where jobs are stored."""
        return shutil.disk_usage(self._data).free

    def is_running(self) -> bool:
        """Whether queued jobs will be run."""
        return self._thread.is_alive() and not self._closing

    def _run_queued(self) -> None:
        while not self._closing:
            self._wake.wait()
            self._wake.clear()
            while not self._closing and (job := self.repository.next_queued()) is not None:
                self._run_one(job)

    def _run_one(self, job: Job) -> None:
        folder = self.folder(job.id)
        folder.mkdir(parents=True, exist_ok=True)
        withdraw_cancel(folder)
        try:
            self.repository.apply(job.id, Trigger.START)
        except JobStateError:
            return  # cancelled since it was read
        trigger, failure = Trigger.SUCCEED, None
        try:
            if self._closing:
                request_cancel(folder)
            self._run(self.captures.locate(job.spec), folder, self.repository.address_of(job.id))
        except JobCancelledError:
            trigger = Trigger.STOPPED if self.repository.get(job.id).state is JobState.CANCELLING else Trigger.LOSE
        except DentineError as problem:
            trigger, failure = Trigger.FAIL, Failure.of(problem, self._stage(job))
        except Exception as problem:
            logging.getLogger(__name__).exception("job %s", job.id)
            message = f"Stage {self._stage(job)} broke with {type(problem).__name__}: {problem}; please report it with the server's log."
            trigger, failure = Trigger.FAIL, Failure(code="internal-error", message=message, exit_status=1, stage=self._stage(job))
        self.repository.apply(job.id, trigger, failure)

    def _stage(self, job: Job) -> StageName | None:
        latest = self.repository.events_of(job.id).latest()
        return latest[-1].stage if latest else None


def _stage_progress(job: Job, stage: StageName, last: JobEvent | None) -> StageProgress:
    if last is None:
        return StageProgress(stage=stage, state="waiting", attempt=0, done=0.0, message="")
    state = "finished" if last.kind == "finished" else "stopped" if job.state.is_final else "running"
    return StageProgress(stage=stage, state=state, attempt=last.attempt, done=last.done or 0.0, message=last.message)
