"""Runs queued jobs side by side, each in a thread of the server, and queues jobs again whose server has died."""

from __future__ import annotations

import errno
import logging
import secrets
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from sqlalchemy.exc import DBAPIError

from services.api.jobs.admission import Admission, queue_order
from services.api.jobs.records import Failure, Job, Lease
from services.api.jobs.repository import Repository
from services.api.tables.lifecycle import JobState, Transition, Trigger
from services.client.errors import JobStateError
from services.core.errors import (
    DentineError,
    DiskFullError,
    FencedError,
    JobCancelledError,
    ReadOnlyStoreError,
    SchedulerLostError,
)
from services.core.records import JobSpec
from services.core.stage import StageName
from services.core.store import translate_disk_errors
from services.pipeline.database import is_full, retry_while_lost
from services.pipeline.event_log import EventAddress
from services.pipeline.logs import log_context
from services.pipeline.stages import first_stage, request_cancel, withdraw_cancel

RunJob = Callable[[JobSpec, Path, EventAddress], object]
"""Function that runs a job in a folder to its end, with its events to the given address; it raises what a stage
raises."""

LEASE_S = 60.0
"""Length of a lease in s: a job stays so long with a server that no longer answers."""
ROUND_S = 10.0
"""Time in s between two rounds, in which leases are renewed, lost ones are found and waiting jobs are looked at
again."""
STOPS_WITHOUT_DISK = "Waits for disk: it is full, so the job's tasks are stopped one by one; free some space."
"""Sentence on a job whose folder takes no file that tells it to stop."""


class NoFreeSlotError(Exception):
    """A job has captured, and there is no slot yet for its other stages."""


class Runner:
    """Runs jobs between ``start`` and ``close``, each in a thread of its own.

    Args:
        folder: returns the folder of a job by its id.
        locate: returns a job's options with the folder of an uploaded capture.
        on_round: called in every round.
        on_success: called with a job that has succeeded, and the mean number of jobs that shared the workers while it
            ran.
        redact: returns the reason why a job failed or waits in a form that everybody who sees the job may read.
    """

    def __init__(
        self,
        repository: Repository,
        folder: Callable[[str], Path],
        locate: Callable[[JobSpec], JobSpec],
        run: RunJob,
        admission: Admission,
        on_round: Callable[[], None],
        on_success: Callable[[Job, float], None],
        redact: Callable[[str, JobSpec], str] = lambda sentence, _: sentence,
    ) -> None:
        self._redact = redact
        self._repository, self._folder, self._locate, self._run, self._admission = (
            repository,
            folder,
            locate,
            run,
            admission,
        )
        self._on_round, self._on_success = on_round, on_success
        self._holder = f"{socket.gethostname()}-{secrets.token_hex(4)}"
        self._wake, self._closing, self._lock = threading.Event(), threading.Event(), threading.Lock()
        self._running: dict[str, tuple[Lease, threading.Thread]] = {}
        self._reported_obstacles: dict[str, str | None] = {}
        self._untold: dict[str, str | None] = {}
        self._unrecorded: set[str] = set()
        loops = {"jobs": self._start_jobs, "leases": self._maintain_leases, "rounds": self._make_rounds}
        self._threads = [threading.Thread(target=loop, name=name) for name, loop in loops.items()]

    def start(self, *, alone: bool) -> None:
        """Start the threads. ``alone`` says that no other server shares the database, so that jobs under way there were
        left by a server that died.
        """
        if alone:
            self._repository.lose()
        self._wake.set()
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ask the running jobs to stop, without waiting for them. They stay queued and resume when a server starts
        again.
        """
        self._closing.set()
        self._wake.set()
        for lease in self._leases():
            self.tell_to_stop(lease.job.id)  # a fault of one folder must not keep others from going dark

    def close(self) -> None:
        """Stop the running jobs cooperatively, and wait for their end."""
        self.stop()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        # A job that was started meanwhile has asked for its own end; see _prepare.
        for _, thread in self._running_jobs():
            thread.join()

    def tell_to_stop(self, job_id: str) -> None:
        """Ask a job to stop. Where its folder takes no file, the job is remembered, and ``is_cancelled`` says it."""
        try:
            request_cancel(self._folder(job_id))
        except OSError as problem:
            if job_id not in self._untold:
                logging.getLogger(__name__).warning("job %s cannot be told yet to stop: %s", job_id, problem)
            if job_id in self._running:
                is_full = problem.errno in {errno.ENOSPC, errno.EDQUOT}
                self._untold[job_id] = STOPS_WITHOUT_DISK if is_full else None
        else:
            self._untold.pop(job_id, None)

    def is_cancelled(self, job_id: str) -> bool:
        """Whether a job is to stop and its folder took no file that says so; tries again to write that file."""
        if job_id not in self._untold:
            return False
        self.tell_to_stop(job_id)
        return True

    def waits_for_disk(self, job_id: str) -> str | None:
        """Why a job of this server does not stop, or its end is not recorded, for lack of disk; None if it does."""
        if job_id in self._unrecorded:
            return "Waits for disk: that of the database is full, so the job's end is not recorded; free some space."
        return self._untold.get(job_id)

    def wake(self) -> None:
        """Wake the thread that starts jobs."""
        self._wake.set()

    def require_slot(self, job_id: str) -> None:
        """Require a slot for a stage that follows a job's capture; called before each such stage in the job's own
        thread.

        Raises:
            NoFreeSlotError: all slots are taken.
        """
        if not self._admission.try_claim_slot(job_id):
            raise NoFreeSlotError

    @property
    def is_running(self) -> bool:
        """Whether queued jobs will be run."""
        return all(thread.is_alive() for thread in self._threads) and not self._closing.is_set()

    def _running_jobs(self) -> list[tuple[Lease, threading.Thread]]:
        with self._lock:
            return list(self._running.values())

    def _leases(self) -> list[Lease]:
        return [lease for lease, _ in self._running_jobs()]

    def _start_jobs(self) -> None:
        while not self._closing.is_set():
            self._wake.wait()
            self._wake.clear()
            try:
                self._start_admitted()
            except Exception:  # a fault of the database or the data folder
                logging.getLogger(__name__).exception("starting jobs failed; trying again in %g s", ROUND_S)

    def _start_admitted(self) -> None:
        # Go through the queued jobs in turn; those that wait for disk or workers let others pass.
        queued = sorted(self._repository.queued(), key=queue_order)
        self._admission.begin_round(job.id for job in queued)
        self._reported_obstacles = {
            job.id: reported for job in queued if (reported := self._reported_obstacles.get(job.id)) is not None
        }
        for job in queued:
            if self._closing.is_set():
                return
            spec, is_to_capture = self._locate(job.spec), first_stage(job.spec, self._folder(job.id)) == "capture"
            if self._admission.holds(job.id, spec, is_to_capture=is_to_capture):
                self._report_obstacle(job.id, spec)
                continue
            self._reported_obstacles.pop(job.id, None)
            try:
                lease = self._repository.lease(job.id, self._holder, LEASE_S)
            except JobStateError:
                continue  # cancelled, or another server's by now
            self._admission.start(job.id, job.number, spec, is_to_capture=is_to_capture)
            thread = threading.Thread(target=self._run_in_thread, args=(lease,), name=f"job-{job.id}")
            with self._lock:
                self._running[job.id] = lease, thread
            thread.start()

    def _report_obstacle(self, job_id: str, located: JobSpec) -> None:
        # Write the obstacle as an event, so that clients that watch the job see it at once; once for each kind of
        # obstacle, as its numbers change all the time. That others are first in line is not written, as nobody can act
        # on it.
        reason = self._admission.reason(job_id, ignore_queue=True)
        kind = None if reason is None else reason.partition(":")[0]
        if kind != self._reported_obstacles.get(job_id):
            self._reported_obstacles[job_id] = kind
            if reason is not None:
                self._repository.append_message(job_id, self._redact(reason, located))

    def _run_in_thread(self, lease: Lease) -> None:
        job = lease.job
        try:
            with log_context(job=job.id, request_id=job.request_id):
                self._run_one(lease)
        except Exception:  # a fault of database or data folder; the job is lost when its lease ends
            logging.getLogger(__name__).exception("job %s broke off; it is queued again within %g s", job.id, LEASE_S)
        finally:
            with self._lock:
                del self._running[job.id]
            self._untold.pop(job.id, None)
            self._unrecorded.discard(job.id)
            self._admission.end(job.id)
            self._wake.set()

    def _maintain_leases(self) -> None:
        log = logging.getLogger(__name__)
        while not self._closing.wait(ROUND_S):
            try:
                self._renew_leases()
                self._admission.find_stalled()
            except Exception:
                log.exception("looking after jobs failed; trying again in %g s", ROUND_S)
            self._wake.set()

    def _renew_leases(self) -> None:
        log = logging.getLogger(__name__)
        leases = self._leases()
        for lease in leases:  # first, because a full disk takes no renewals
            if self._is_cancelled(lease):
                self.tell_to_stop(lease.job.id)
        for lease in leases:
            if not self._repository.renew(lease, LEASE_S):
                log.warning("job %s was taken over by another server", lease.job.id)
        for job_id in self._repository.lose_expired(leases, LEASE_S):
            log.warning("job %s was lost by its server and is queued again", job_id)

    def _make_rounds(self) -> None:
        # The rounds have a thread of their own, because a deletion of many files takes longer than a lease lasts.
        while not self._closing.wait(ROUND_S):
            try:
                self._on_round()
            except Exception:
                logging.getLogger(__name__).exception("the round failed; trying again in %g s", ROUND_S)

    def _run_one(self, lease: Lease) -> None:
        job, folder = lease.job, self._folder(lease.job.id)
        trigger, failure, is_begun = Trigger.SUCCEED, None, False
        try:
            self._prepare(lease, folder)
            is_begun = True
            self._run(self._locate(job.spec), folder, self._repository.address_of(lease))
        except JobCancelledError:
            trigger = self._after_cancel(job)
        except FencedError as problem:
            logging.getLogger(__name__).warning("job %s: %s", job.id, problem)
            return
        except NoFreeSlotError:
            trigger = Trigger.PAUSE
        except (DiskFullError, ReadOnlyStoreError, SchedulerLostError) as problem:
            self._admission.pause(job.id, problem)
            trigger = Trigger.PAUSE
        except DentineError as problem:
            trigger, failure = Trigger.FAIL, Failure.of(problem, self._stage(job))
        except Exception as problem:
            if not is_begun:
                raise  # the job itself did not break; its next lease may go well
            logging.getLogger(__name__).exception("Job broke.")
            message = (
                f"Stage {self._stage(job)} broke with {type(problem).__name__}: {problem}; please report it with the"
                " server's log."
            )
            trigger, failure = (
                Trigger.FAIL,
                Failure(code="internal-error", message=message, exit_status=1, stage=self._stage(job)),
            )
        if failure is not None:
            failure = failure.model_copy(update={"message": self._redact(failure.message, self._locate(job.spec))})
        self._settle(lease, trigger, failure)

    def _settle(self, lease: Lease, trigger: Trigger, failure: Failure | None) -> None:
        try:
            transition = retry_while_lost(lambda: self._record_end(lease, trigger, failure))
        except FencedError as problem:
            logging.getLogger(__name__).warning("job %s: %s", lease.job.id, problem)
            return
        logging.getLogger(__name__).info(
            "Job ran.", extra={"state": transition.state, "failure": failure.code if failure else None}
        )
        if transition.state is JobState.SUCCEEDED:
            self._on_success(lease.job, self._admission.mean_sharing(lease.job.id))

    def _record_end(self, lease: Lease, trigger: Trigger, failure: Failure | None) -> Transition:
        try:
            return self._repository.settle(lease, trigger, failure)
        except DBAPIError as problem:
            if is_full(problem):
                self._unrecorded.add(lease.job.id)
            raise

    def _prepare(self, lease: Lease, folder: Path) -> None:
        with translate_disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            withdraw_cancel(folder)
            if self._closing.is_set() or self._is_cancelled(lease):
                request_cancel(folder)

    def _after_cancel(self, job: Job) -> Trigger:
        # The cancel came from a user, from the end of this server, or from neither: tasks can also be cancelled in Dask
        # itself. Then the job goes on, but after a pause, so that this does not repeat over and over at once.
        if retry_while_lost(lambda: self._repository.get(job.id).state) is JobState.CANCELLING:
            return Trigger.STOPPED
        if self._closing.is_set():
            return Trigger.LOSE
        self._admission.pause(
            job.id,
            SchedulerLostError(
                "The workers dropped the job's tasks, which nobody had asked for here; it goes on by itself."
            ),
        )
        return Trigger.PAUSE

    def _is_cancelled(self, lease: Lease) -> bool:
        return self._repository.get(lease.job.id).state is JobState.CANCELLING

    def _stage(self, job: Job) -> StageName | None:
        latest = self._repository.events_of(job.id).latest()
        return latest[-1].stage if latest else None
