"""Strings the stages together on Dask: records travel between tasks, pixels go through the store.

::

    phantom {STAGES: 1} -> capture {DOME: 1} -> prepare {STAGES: 1} -> fit {STAGES: 1} -> export {STAGES: 1}

A capture only where the job names a rig, a phantom only where that is the demonstration's.

Each stage is one task, submitted once the one before has ended, so that nothing is needed of a worker that has done its part: a rig may go away
after its capture. A stage that is published already is skipped, so the same call starts, resumes and repeats a job. A task whose worker dies is run again by
Dask on another worker; it then counts one attempt more than any before, which fences whatever the old one may still write. The fit spreads its passes over the
same workers and secedes from its own slot meanwhile.
"""

from __future__ import annotations

import fcntl
import importlib
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from services.core.errors import (
    CorruptStoreError,
    InputError,
    JobCancelledError,
    MissingStageError,
    PlatformError,
    SchedulerLostError,
    WorkerLostError,
)
from services.core.events import JobEvent
from services.core.job_kinds import job_kinds
from services.core.masks import is_stale
from services.core.placement import DOME, STAGES, rank
from services.core.records import LIMITS_OF_A_RIG, AssetManifest, JobSpec
from services.core.stage import CANCEL_FLAG, LocalContext, StageEvent, StageName
from services.core.store import (
    is_published,
    open_stage,
    read_record,
    require_intact,
    telling_disk_faults,
    withdraw,
    write_record,
)
from services.pipeline.database import patiently
from services.pipeline.event_log import EventAddress, EventLog, folder_events
from services.pipeline.machine_class import machine_class
from services.pipeline.workers import Workers

if TYPE_CHECKING:
    from distributed import Client, Future

Listener = Callable[[JobEvent], None]

JOB_FILE = "job.json"
DAMAGE_FLAG = ".damaged"
"""In a job's folder: a stage found another one's published files damaged, so the next run looks for what it must make anew."""
POLL_S = 0.25
KEEP_S = 10.0
"""How often workers that were given up are started again."""
GRACE_S = 5.0
"""How long a cancelled stage may take to notice before its worker is stopped. A capture is always awaited: it darkens the dome."""

DOORS: Mapping[StageName, str] = MappingProxyType({})
"""``module:function`` of stages that are entered elsewhere than a job's kind says."""
_PUBLISHED_AS = {"phantom": "phantom", "capture": "capture", "prepare": "prepared", "fit": "fit", "export": "asset"}
_EXTRAS = {"phantom": "fit", "capture": "capture", "prepare": "preprocess", "fit": "fit", "export": "fit"}
"""What to install where a stage runs."""


def stages_of(spec: JobSpec) -> tuple[StageName, ...]:
    """The stages a job goes through, in order."""
    made = (*(("phantom",) if spec.is_demo else ()), *(("capture",) if spec.rig is not None else ()))
    return (*made, *job_kinds()[spec.kind].stages)


def first_stage(spec: JobSpec, root: Path) -> StageName | None:
    """The first stage of a job that is not published yet; None where all are."""
    return next((stage for stage in stages_of(spec) if not is_published(root, _PUBLISHED_AS[stage])), None)


def run_job(
    spec: JobSpec,
    root: Path,
    listener: Listener | None = None,
    workers: int | None = None,
    events: EventAddress | None = None,
    doors: Mapping[StageName, str] = DOORS,
    cluster: Workers | None = None,
    *,
    is_logged: bool = False,
    before: Callable[[], None] | None = None,
    phantoms: Path | None = None,
) -> AssetManifest:
    """Run a job to its asset; needs no server.

    Args:
        root: the job's folder; its published stages are kept and skipped.
        listener: called in this thread with every new event.
        workers: worker processes, default ``spec.workers``.
        events: event table to append to, default one in ``root``.
        doors: where stages are entered other than the job's kind says.
        cluster: where it runs, default workers of its own.
        is_logged: workers write log lines on standard error.
        before: called before each stage but a capture; what it raises ends the run.
        phantoms: folder in which the demonstration's mouth is kept from job to job, seen by the workers; None to make it anew for each.

    Raises:
        DentineError: whatever a stage raised; JobCancelledError after ``request_cancel(root)``.
    """
    run_stages(
        spec,
        root,
        stages_of(spec),
        listener,
        workers,
        events,
        doors,
        cluster,
        is_logged=is_logged,
        before=before,
        phantoms=phantoms,
    )
    return open_stage(root, "asset", AssetManifest, verify=False)[1]


def run_stages(
    spec: JobSpec,
    root: Path,
    stages: tuple[StageName, ...],
    listener: Listener | None = None,
    workers: int | None = None,
    events: EventAddress | None = None,
    doors: Mapping[StageName, str] = DOORS,
    cluster: Workers | None = None,
    *,
    again: bool = False,
    is_logged: bool = False,
    before: Callable[[], None] | None = None,
    phantoms: Path | None = None,
) -> None:
    """Run some stages of a job in order; see ``run_job``. ``again`` runs those that are published too."""
    root = root.resolve()
    with telling_disk_faults(root), _sole_owner(root):
        _claim_folder(root, spec)
        if (root / DAMAGE_FLAG).exists():
            _withdraw_damaged(root)
        if "prepare" in stages and is_stale(root):
            _withdraw_prepared(root)
        address = events or folder_events(root)
        todo = tuple(stage for stage in stages if again or not is_published(root, _PUBLISHED_AS[stage]))
        with address.open() as log:
            watch = _Watch(log, listener, log.newest_id())
            if todo:
                entered = {**job_kinds()[spec.kind].doors, **doors}
                tasks = [
                    StageTask(
                        stage, entered[stage], _seen_by(stage, spec, root, phantoms), root, address, again, is_logged
                    )
                    for stage in todo
                ]
                with _remembering_damage(root), nullcontext(cluster) if cluster is not None else Workers() as processes:
                    _run_tasks(processes, workers or spec.workers, tasks, watch, before or _go_on)
            watch.tell()


def _seen_by(stage: StageName, spec: JobSpec, root: Path, phantoms: Path | None) -> JobSpec:
    """The options as a stage sees them: the demonstration's mouth is where such mouths are kept, and then the one made for this job."""
    if spec.rig is None or not spec.is_demo:
        return spec
    mouth = (phantoms or spec.rig.mouth) if stage == "phantom" else root / _PUBLISHED_AS["phantom"]
    return spec.model_copy(update={"rig": spec.rig.model_copy(update={"mouth": mouth})})


def request_cancel(root: Path) -> None:
    """Ask whoever runs the job in this folder to stop between two frames or steps."""
    (root / CANCEL_FLAG).touch()


def withdraw_cancel(root: Path) -> None:
    """Forget an earlier cancel request; call before a job is started again."""
    (root / CANCEL_FLAG).unlink(missing_ok=True)


@dataclass(frozen=True)
class StageTask:
    """What a worker needs to run one stage."""

    stage: StageName
    door: str
    spec: JobSpec
    root: Path
    events: EventAddress
    again: bool = False
    is_logged: bool = False

    def __call__(self) -> str:
        """Run the stage unless a worker that died afterwards has published it; returns the stage's name."""
        folder = _PUBLISHED_AS[self.stage]
        if is_published(self.root, folder) and not self.again:
            return self.stage
        with self.events.open() as log:
            lease = self.root / f"{folder}.lease"
            known, machine = int(lease.read_text()) if lease.exists() else 0, machine_class()
            attempt = patiently(lambda: log.begin_stage(self.stage, known, machine))
            told: set[str] = set()

            def tell(event: StageEvent) -> None:
                if event.kind != "started":  # begin_stage has recorded it
                    patiently(lambda: log.append(attempt, event))
                told.add(event.kind)
                write_line(event)

            with self._logs(attempt) as write_line:
                context = LocalContext(self.root, attempt, tell)
                context.raise_if_cancelled()
                module, function = self.door.split(":")
                with telling_disk_faults(self.root), _telling_a_missing_package(self.stage):
                    getattr(importlib.import_module(module), function)(self.spec, context)
                if "finished" not in told:
                    tell(StageEvent(stage=self.stage, kind="finished", done=1.0))
        return self.stage

    def _logs(self, attempt: int) -> AbstractContextManager[Callable[[StageEvent], None]]:
        """The worker's log lines, or silence."""
        if not self.is_logged:
            return nullcontext(lambda _event: None)
        from services.pipeline.logs import stage_logs

        return stage_logs(self.stage, attempt, self.events)


@contextmanager
def _telling_a_missing_package(stage: StageName) -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as problem:
        if (problem.name or "services").partition(".")[0] == "services":
            raise
        extra = _EXTRAS[stage]
        what = f"Stage {stage} needs {problem.name}, which its workers do not have; install dentine[{extra}] where they run, then retry the job."
        raise PlatformError(what) from problem


class _Watch:
    """Passes new rows of the event table to the listener."""

    def __init__(self, log: EventLog, listener: Listener | None, after: int) -> None:
        self._log, self._listener, self._after = log, listener, after

    def tell(self) -> None:
        while new := patiently(lambda: self._log.read(self._after)):
            for event in new:
                if self._listener is not None:
                    self._listener(event)
            self._after = new[-1].id


def _go_on() -> None:
    """Nothing keeps the next stage."""


def _run_tasks(
    processes: Workers, count: int, tasks: list[StageTask], watch: _Watch, before: Callable[[], None]
) -> None:
    """Submit each stage once the one before has ended, follow its events, and raise what it raises."""
    from distributed.comm import CommClosedError

    try:
        with processes.serving(count, captures=any(task.stage == "capture" for task in tasks)) as client:
            for task in tasks:
                if task.stage != "capture":
                    before()
                _follow_stage(client, processes.keep, task, watch)
    except (CancelledError, CommClosedError) as problem:
        raise SchedulerLostError(
            "The workers' scheduler went away; the job goes on from what it had published once it answers again."
        ) from problem


def _follow_stage(client: Client, keep_workers: Callable[[], None], task: StageTask, watch: _Watch) -> None:
    from distributed import KilledWorker

    key = f"{task.stage}-{task.events.job}-{secrets.token_hex(4)}"  # its own, as Dask answers for a key that it still knows with the old result
    needed = {DOME: 1} if task.stage == "capture" else {STAGES: 1}
    stage: Future = client.submit(task, key=key, resources=needed, priority=-rank(task.spec.priority), pure=False)
    flag, give_up_at, keep_at = task.root / CANCEL_FLAG, None, time.monotonic() + KEEP_S
    has_ended = False
    while not has_ended:
        has_ended = _has_ended(stage)
        watch.tell()
        if time.monotonic() > keep_at:
            keep_workers()
            keep_at = time.monotonic() + KEEP_S
        if give_up_at is None and flag.exists():
            give_up_at = time.monotonic() + GRACE_S
        # By the task and not by its last event: one that no worker takes on tells of nothing, and the capture before it has ended.
        if not has_ended and give_up_at is not None and time.monotonic() > give_up_at and task.stage != "capture":
            _stop_workers_of(client, key)
            raise JobCancelledError(
                "The job was cancelled on request; its workers were stopped, and what it had published is kept."
            )
    try:
        if stage.status != "finished":
            stage.result()
    except KilledWorker as problem:
        raise WorkerLostError(
            f"Every worker that took on stage {task.stage} died {problem.allowed_failures + 1} times; free some memory or set fewer workers, then run again.",
            {"stage": task.stage, "deaths": problem.allowed_failures + 1},
        ) from problem


def _has_ended(stage: Future) -> bool:
    """Whether a task has failed, or its result is here; asks for ``POLL_S`` at most.

    A task that has finished has not ended before that: its worker may die with the result, and then the task runs again.
    """
    from distributed import wait

    try:
        wait([stage], timeout=POLL_S)
        if stage.status == "finished":
            stage.result(timeout=POLL_S)
    except TimeoutError:
        return False
    return True


def _stop_workers_of(client: Client, stage: str) -> None:
    # Those that hold the stage or tasks that it has made, whose keys begin with its own. Each is started again, and what
    # another job had there runs again.
    busy = [worker for worker, keys in client.processing().items() if any(str(key).startswith(stage) for key in keys)]
    with suppress(TimeoutError):
        client.restart_workers(busy, timeout=GRACE_S)


@contextmanager
def _sole_owner(root: Path) -> Iterator[None]:
    """Hold the folder's lock; the system drops it however this process ends."""
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"Folder {root} is in use by another running job; wait for it or choose another folder."
            ) from None
        yield


def _withdraw_prepared(root: Path) -> None:
    """Remove what was made with masks by hand that have changed since; last what says so, so that a kill in between is gone on with."""
    for result in ("report.html", "parameters.json", "errors.json"):
        (root / result).unlink(missing_ok=True)
    for folder in ("asset", "fit", "prepared"):
        withdraw(root, folder)


@contextmanager
def _remembering_damage(root: Path) -> Iterator[None]:
    # Not withdrawn at once: whoever has a copy may restore it before a retry.
    try:
        yield
    except CorruptStoreError:
        (root / DAMAGE_FLAG).touch()
        raise


def _withdraw_damaged(root: Path) -> None:
    """Remove published stages that are not as published, so that they are run again; those after them were made of the whole ones. Never a capture."""
    for stage in ("prepared", "fit", "asset"):
        try:
            require_intact(root, stage)
        except CorruptStoreError:
            withdraw(root, stage)
        except MissingStageError:
            continue
    (root / DAMAGE_FLAG).unlink()


def _claim_folder(root: Path, spec: JobSpec) -> None:
    """Write the job's options, or refuse a folder that holds the results of other ones."""
    path, indifferent = root / JOB_FILE, {"workers", "priority"}
    if path.exists():
        earlier = read_record(path, JobSpec)
        theirs, ours = (_options(one) for one in (earlier, spec))
        changed = sorted(name for name in ours if name not in indifferent and ours[name] != theirs[name])
        if changed:
            raise InputError(
                f"Folder {root} holds a job with other options ({', '.join(changed)}); choose another folder or remove it."
            )
    write_record(path, spec)


def _options(spec: JobSpec) -> dict[str, Any]:
    # A server that lowers how far a rig may go does not make another job of it.
    return spec.model_dump(mode="json", exclude={"rig": set(LIMITS_OF_A_RIG)})
