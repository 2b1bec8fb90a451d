"""Use cases of jobs: submit, cancel, retry and delete them, and tell how far they are."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pydantic import Field

from services.api.auth.departures import departures
from services.api.calibrations.calibrations import Calibrations, is_stored
from services.api.captures.captures import Captures, is_uploaded
from services.api.captures.reading import SubprocessReader
from services.api.data_folder import OpenedFolder, keep_password_apart, require_own_folder
from services.api.jobs.admission import Admission, Machine
from services.api.jobs.erasure import erase, forget_listing
from services.api.jobs.light_limits import LightLimits, require_recent
from services.api.jobs.records import Creation, Deletion, Job
from services.api.jobs.repository import Repository
from services.api.jobs.runner import RunJob, Runner
from services.api.jobs.server_paths import ServerPaths, ServerStores
from services.api.jobs.time_ranges import TimeRange, TimeRanges
from services.api.tables.jobs import JobFilter
from services.api.tables.lifecycle import Instruction, JobState, Trigger
from services.client.errors import JobStateError, UnknownJobError
from services.core.errors import DentineError, SettingsError
from services.core.events import JobEvent
from services.core.geometry import Record
from services.core.light.flash_record import used_in
from services.core.light.safety import FlashAcknowledgement
from services.core.masks import is_stale
from services.core.owners import LOCAL_VIEWER, Viewer
from services.core.provenance.record import SUBJECT_FILE
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageName
from services.core.store import is_published, write_atomic
from services.pipeline.event_log import EventAddress
from services.pipeline.machine_class import machine_class
from services.pipeline.stages import stages_of

DAY_S = 86400.0
MAX_RUNNING = 1000
"""Upper bound of the number of jobs under way: each of them takes one thread of a server."""


class StageProgress(Record):
    """How far one stage of a job is."""

    stage: StageName
    state: str = Field(description="waiting, running, finished, or stopped where it was begun and the job does not run")
    attempt: int = Field(description="0 before the first")
    done: float = Field(description="fraction, 0 to 1")
    message: str


class Jobs:
    """Use cases of jobs over one data folder. Jobs run between ``start`` and ``close``.

    Args:
        missing_workers: returns why no worker can run a stage; see ``Admission``.

    Raises:
        SettingsError: the database belongs to another data folder.
    """

    def __init__(
        self, settings: ServerSettings, run: RunJob, missing_workers: Callable[[bool], str | None] = lambda _: None
    ) -> None:
        self._data, self._keep_days = settings.data.resolve(), settings.keep_days
        self._data.mkdir(parents=True, exist_ok=True)
        self.repository = Repository(keep_password_apart(settings.database_url, self._data))
        require_own_folder(self.repository.engine, self._data, lies_in_folder=settings.database is None)
        self._opened = OpenedFolder(self._data)
        self.reader = SubprocessReader()
        self.captures = Captures(self.repository.engine, self._data, settings.uploads, reader=self.reader)
        self.calibrations = Calibrations(self._data)
        self._light_limits, self.server_paths = LightLimits(settings.dome), ServerPaths.of(settings)
        self._stores = ServerStores(settings)
        has_workers, machine = settings.scheduler is None, machine_class() if settings.scheduler is None else None
        self._admission = Admission(
            lambda: Machine.of(self._data, has_workers=has_workers),
            max_running=settings.jobs_at_once,
            missing_workers=missing_workers,
        )
        slots, running = settings.jobs_at_once, lambda: self._admission.sharing
        self._time_ranges = TimeRanges(
            self.repository, self.locate, self._obstacle, machine, slots, running, self.reader.describe
        )

        def run_within_limits(spec: JobSpec, folder: Path, events: EventAddress) -> object:
            self._stores.require(spec)
            if (subject := self.captures.subject_of(spec)) is not None:
                write_atomic(folder / SUBJECT_FILE, f"{subject}\n".encode())
            return run(self._light_limits.lowered(spec), folder, events)

        self._runner = Runner(
            self.repository,
            self.folder,
            self.locate,
            run_within_limits,
            self._admission,
            self._tidy,
            self._time_ranges.learn,
            self.server_paths.redact,
        )
        self._is_alone = settings.database is None
        self._deleting = threading.Lock()

    def start(self) -> None:
        """Start to run jobs. Jobs that an earlier server left unfinished are queued again."""
        self._runner.start(alone=self._is_alone)

    def stop(self) -> None:
        """Ask the running jobs to stop, without waiting for them; the domes that they light go dark at once."""
        self._runner.stop()

    def close(self) -> None:
        """Stop the running jobs cooperatively; they stay queued and resume when the server starts again."""
        self._runner.close()
        self.reader.close()
        self.repository.close()

    def require_slot(self, job_id: str) -> None:
        """Require a slot for the next stage of a job that has captured; see ``Runner.require_slot``."""
        self._runner.require_slot(job_id)

    def folder(self, job_id: str) -> Path:
        """Return the folder of a job's stages and results."""
        return self._data / "jobs" / job_id

    def present_folder(self, job_id: str) -> Path:
        """Return the folder of a job's results, once it is certain that no other folder lies in its place.

        Raises:
            PlatformError: the data folder is not the one that was opened.
        """
        self._opened.require_present()
        return self.folder(job_id)

    def locate(self, spec: JobSpec) -> JobSpec:
        """Return a job's options with the paths of the files that the server stores for it."""
        return self.calibrations.locate(self.captures.locate(spec))

    def submit(
        self,
        spec: JobSpec,
        key: str | None = None,
        request_id: str | None = None,
        name: str | None = None,
        viewer: Viewer = LOCAL_VIEWER,
    ) -> Creation:
        """Queue a job, with a label if one is given.

        Raises:
            SettingsError: a path is relative, absent or not allowed, its store is not allowed, an uploaded capture is
                not committed or somebody else's, or another option is not acceptable.
            JobTooLargeError: the machine could never run it.
            ExposureLimitError: one exposure of its rig is over the largest dose of one light. JobStateError: the key
                belongs to another job.
        """
        self._opened.require_present()
        spec = self.calibrations.by_content(spec, viewer)
        if key is not None and (earlier := self.repository.submitted(spec, key, viewer)) is not None:
            return Creation(earlier, is_new=False)
        if spec.channels == ():
            raise SettingsError("Option 'channels' is empty; name a channel, or leave it out to fit all.")
        if spec.capture is not None and not is_uploaded(spec.capture):
            self.server_paths.require("capture", spec.capture, "upload it, with dentine submit --upload or in the page")
        self._stores.require(spec)
        if spec.rig is not None:
            self._light_limits.require(spec.rig)
            require_recent(spec.rig)
        if spec.rig is not None and not spec.is_demo and not is_uploaded(spec.rig.mouth):
            remedy = "upload it with dentine submit --upload, or try the demonstration with dentine demo"
            self.server_paths.require("rig.mouth", spec.rig.mouth, remedy)
        if spec.calibration is not None and is_stored(spec.calibration):
            self.calibrations.require(spec.calibration, viewer, accepted=spec.accept_calibration)
        elif spec.calibration is not None:
            self.server_paths.require("calibration", spec.calibration)
        self._admission.refuse_too_large(
            self.locate(spec)
        )  # before the lock below, as it walks through the capture and others would wait
        with self.captures.holding(spec, viewer):
            creation = self.repository.create(spec, key, request_id, name, viewer)
        logging.getLogger(__name__).info("Job submitted.", extra={"job": creation.job.id, "is_new": creation.is_new})
        self._runner.wake()
        return creation

    def cancel(self, job_id: str) -> Job:
        """Cancel a job; a running one stops between two frames or steps, or in mid-kernel.

        A cancel that is recorded is carried out, also where the disk of the job's folder is full.

        Raises:
            UnknownJobError: there is no such job. JobStateError: it has ended.
        """
        if self.repository.get(job_id).state is JobState.RUNNING:
            # Darken before the cancellation is recorded: reading the database never waits, writing to it may take
            # seconds.
            self._runner.tell_to_stop(job_id)
        if self.repository.apply(job_id, Trigger.CANCEL).instruction is Instruction.STOP:
            self._runner.tell_to_stop(job_id)  # again, as a job that has just begun withdraws an earlier request
        return self.repository.get(job_id)

    def is_cancelled(self, job_id: str) -> bool:
        """Whether a job is to stop, and its folder takes no flag that says so; see ``Runner.is_cancelled``."""
        return self._runner.is_cancelled(job_id)

    def retry(self, job_id: str, flashes: FlashAcknowledgement | None = None) -> Job:
        """Queue a failed or cancelled job again, or a succeeded one whose masks were changed; it resumes from its
        published results that are still valid.

        Args:
            flashes: acknowledgement of faster flashes, in place of the job's own.

        Raises:
            UnknownJobError: there is no such job. JobStateError: its state does not allow a retry. SettingsError: the
                acknowledgement is not allowed, or one is needed.
        """
        self._opened.require_present()
        spec = self._with_flashes(self.repository.get(job_id), flashes)
        is_revised = self.repository.get(job_id).state is JobState.SUCCEEDED and is_stale(self.folder(job_id))
        self.repository.apply(job_id, Trigger.REVISE if is_revised else Trigger.RETRY, spec=spec)
        self._runner.wake()
        return self.repository.get(job_id)

    def _with_flashes(self, job: Job, flashes: FlashAcknowledgement | None) -> JobSpec | None:
        """Return the options of a retry where it brings an acknowledgement; None where they stay as they are."""
        rig = job.spec.rig
        if rig is None:
            if flashes is not None:
                raise SettingsError("'flashes': this job has no rig, so nothing flashes; leave it out.")
            return None
        rig = rig if flashes is None else rig.model_copy(update={"flashes": flashes})
        flashes_again = job.state.is_final and not rig.is_simulated and self._awaiting_capture([job])
        if rig.flashes is not None and flashes_again:
            self._light_limits.require(rig)
            rig.flashes.require_newer(used_in(self.folder(job.id)))
            require_recent(rig)
        return None if flashes is None else job.spec.model_copy(update={"rig": rig})

    def delete(self, job_id: str) -> Deletion:
        """Remove everything that is stored of a job that has ended, and give a receipt.

        Raises:
            UnknownJobError: there is no such job. JobStateError: it has not ended.
            StoreError: a file, or an object on an S3 server, could not be removed; delete the job again.
        """
        self._opened.require_present()
        self.repository.apply(job_id, Trigger.DELETE)
        with self._deleting:
            with suppress(UnknownJobError):
                return self.repository.deletion(job_id)  # a round of the runner has finished this deletion
            erased = erase(self.folder(job_id))
            self._opened.require_present()  # no receipt for files that were moved away meanwhile
            exports = departures(self.repository.engine, job_id)  # now that nothing more can leave
            receipt = self.repository.forget(job_id, erased.files, erased.bytes, erased.digest, exports)
            forget_listing(self.folder(job_id))
            return receipt

    def capturing(self) -> list[Job]:
        """Return the jobs under way, of any server of the database, whose capture is not published yet."""
        return self._awaiting_capture(
            self.repository.page(MAX_RUNNING, only=JobFilter(states=(JobState.RUNNING, JobState.CANCELLING)))
        )

    def lights_again(self, job_id: str) -> bool:
        """Whether a retry of a job would light a dome that is not simulated.

        Raises:
            UnknownJobError: there is no such job.
        """
        return any(
            job.spec.rig is not None and not job.spec.rig.is_simulated
            for job in self._awaiting_capture([self.repository.get(job_id)])
        )

    def cancel_captures(self) -> list[Job]:
        """Cancel every job that captures or will capture next; returns these jobs in their state before."""
        cancelled, capturing = [], self.capturing()
        for job in capturing:  # all before the first is recorded, as each may have a dome of its own
            self._runner.tell_to_stop(job.id)
        for job in self._awaiting_capture(self.repository.queued()) + capturing:
            with suppress(JobStateError):
                self.cancel(job.id)
                cancelled.append(job)
        return cancelled

    def waits_for(self, job: Job) -> str | None:
        """Why a queued job does not start, or a running one does not go on or stop; None if nothing keeps it."""
        if job.state in {JobState.RUNNING, JobState.CANCELLING} and (full := self._runner.waits_for_disk(job.id)):
            return full
        if job.state not in {JobState.RUNNING, JobState.QUEUED}:
            return None
        # Ask only for the obstacle of the state that was read: a job that was read as running may have been paused
        # since.
        find_reason = self._admission.stalled if job.state is JobState.RUNNING else self._admission.reason
        if (reason := find_reason(job.id)) is not None:
            return self.server_paths.redact(reason, self.locate(job.spec))
        return (
            None
            if job.state is JobState.RUNNING or self.is_running()
            else "This server does not run jobs; restart it and read its log."
        )

    def _obstacle(self, job: Job) -> str | None:
        return self._admission.reason(job.id, ignore_queue=True) if job.state is JobState.QUEUED else None

    def time_range(self, job: Job) -> TimeRange | None:
        """How long until a job ends; None if it neither runs nor waits."""
        return self._time_ranges.of(job)

    def progress(self, job: Job) -> list[StageProgress]:
        """How far each stage is, from the event table."""
        latest = {event.stage: event for event in self.repository.events_of(job.id).latest()}
        return [_stage_progress(job, stage, latest.get(stage)) for stage in stages_of(job.spec, latest)]

    def free_bytes(self) -> int:
        """Free disk space in bytes where jobs are stored."""
        return Machine.of(self._data).free_disk_bytes

    def is_running(self) -> bool:
        """Whether queued jobs will be run."""
        return self._runner.is_running

    def _awaiting_capture(self, jobs: list[Job]) -> list[Job]:
        return [job for job in jobs if job.spec.rig is not None and not is_published(self.folder(job.id), "capture")]

    def _tidy(self) -> None:
        # Finish deletions that were interrupted, and delete jobs that ended longer ago than they are to be kept.
        oldest_s = 0.0 if self._keep_days is None else time.time() - self._keep_days * DAY_S
        for job_id in self.repository.ended_before(oldest_s):
            try:
                self.delete(job_id)
            except UnknownJobError:
                continue  # deleted meanwhile
            except (DentineError, OSError) as problem:
                logging.getLogger(__name__).warning("job %s: %s", job_id, problem)


def _stage_progress(job: Job, stage: StageName, last: JobEvent | None) -> StageProgress:
    if last is None:
        return StageProgress(stage=stage, state="waiting", attempt=0, done=0.0, message="")
    state = (
        "finished"
        if last.kind == "finished"
        else "running"
        if job.state in {JobState.RUNNING, JobState.CANCELLING}
        else "stopped"
    )
    return StageProgress(stage=stage, state=state, attempt=last.attempt, done=last.done or 0.0, message=last.message)
