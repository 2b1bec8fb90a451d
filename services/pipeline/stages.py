"""Run the stages of a job in order on Dask: records travel between tasks, pixels go through the store.

::

    phantom {STAGES: 1} -> capture {DOME: 1} -> register {STAGES: 1} -> prepare {STAGES: 1} -> fit {STAGES: 1} -> export
    {STAGES: 1}

A job has a capture only where it names a rig, a phantom only where that rig is the demonstration's, and a registration
only where a raw folder has a scan and no teeth. The latter is checked when the job runs, so a registration is part of
the plan only once it has begun.

Each stage is one task, submitted once the stage before has ended, so a worker is not needed after its stage: a rig may
be disconnected after its capture. A stage that is published already is skipped, so the same call starts, resumes and
repeats a job. Dask runs a task whose worker dies again on another worker; its attempt then has a higher number than any
before, which fences off later writes of the old attempt. The fit spreads its passes over the same workers and secedes
from its own slot meanwhile.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import MappingProxyType
from typing import Any

from services.core.errors import (
    CorruptStoreError,
    InputError,
    MissingStageError,
    SchedulerLostError,
)
from services.core.job_kinds import job_kinds
from services.core.masks import is_stale
from services.core.raw.registration import lacks_pose
from services.core.records import JOB_FILE, LIMITS_OF_A_RIG, JobSpec
from services.core.results import AssetManifest
from services.core.stage import CANCEL_FLAG, StageName
from services.core.store import (
    is_published,
    open_stage,
    read_record,
    require_intact,
    translate_disk_errors,
    withdraw,
    write_record,
)
from services.pipeline.event_log import EventAddress, folder_events
from services.pipeline.following import Listener, Watch, follow_stage, never
from services.pipeline.stage_task import PUBLISHED_AS, StageTask
from services.pipeline.workers import Workers

CANCEL_RESERVE = ".cancel"
"""Name of an empty file in a job's folder, which becomes the flag of a cancel where the disk is full."""
DAMAGE_FLAG = ".damaged"
"""Name of a file in a job's folder. It says that a stage has found published files of another stage damaged, so that
the next run looks for stages that it must run again."""

DOORS: Mapping[StageName, str] = MappingProxyType({})
"""Stage -> ``module:function`` in place of that of the job's kind; empty by default."""


def stages_of(spec: JobSpec, begun: Collection[StageName | None] = ()) -> tuple[StageName, ...]:
    """The stages a job goes through, in order.

    Args:
        begun: the stages that were started; the result has a registration only if it is among them.
    """
    made = (*(("phantom",) if spec.is_demo else ()), *(("capture",) if spec.rig is not None else ()))
    registered: tuple[StageName, ...] = ("register",) if "register" in begun else ()
    return (*made, *registered, *job_kinds()[spec.kind].stages)


def first_stage(spec: JobSpec, root: Path) -> StageName | None:
    """The first stage of a job that is not published yet; None where all are."""
    return next((stage for stage in stages_of(spec) if not is_published(root, PUBLISHED_AS[stage])), None)


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
    is_cancelled: Callable[[], bool] = never,
) -> AssetManifest:
    """Run a job to its asset; needs no server.

    Args:
        root: the job's folder; its published stages are kept and skipped.
        listener: called in this thread with every new event.
        workers: worker processes, default ``spec.workers``.
        events: event table to append to, default one in ``root``.
        doors: stage -> ``module:function`` in place of that of the job's kind.
        cluster: workers to run on, default workers of the run's own.
        is_logged: workers write log lines on standard error.
        before: called before each stage but a capture; an error that it raises ends the run.
        phantoms: folder, accessible to the workers, in which the demonstration's mouth is kept from job to job; None to
            render it anew for each job.
        is_cancelled: whether the job was cancelled, though the flag in its folder may be missing for lack of disk.

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
        is_cancelled=is_cancelled,
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
    is_cancelled: Callable[[], bool] = never,
) -> None:
    """Run some stages of a job in order; see ``run_job``. With ``again``, published stages run too."""
    root = root.resolve()
    with translate_disk_errors(root), _sole_owner(root):
        _claim_folder(root, spec)
        if (root / DAMAGE_FLAG).exists():
            _withdraw_damaged(root)
        if "prepare" in stages and is_stale(root):
            _withdraw_prepared(root)
        address = events or folder_events(root)
        remaining = tuple(
            stage for stage in _with_registration(spec, stages) if again or not is_published(root, PUBLISHED_AS[stage])
        )
        with address.open() as log:
            watch = Watch(log, listener, log.newest_id())
            if remaining:
                stage_functions = {**job_kinds()[spec.kind].doors, **doors}
                tasks = [
                    StageTask(
                        stage,
                        stage_functions[stage],
                        _options_for(stage, spec, root, phantoms),
                        root,
                        address,
                        again,
                        is_logged,
                    )
                    for stage in remaining
                ]
                with _flag_damage(root), nullcontext(cluster) if cluster is not None else Workers() as processes:
                    _run_tasks(processes, workers or spec.workers, tasks, watch, before or _do_nothing, is_cancelled)
            watch.pass_on_events()


def _with_registration(spec: JobSpec, stages: tuple[StageName, ...]) -> tuple[StageName, ...]:
    """The stages with a registration before the preparation of a raw folder whose scan has no pose yet."""
    if "prepare" not in stages or spec.capture is None or "register" not in job_kinds()[spec.kind].doors:
        return stages
    at = stages.index("prepare")
    return (*stages[:at], "register", *stages[at:]) if lacks_pose(spec.capture) else stages


def _options_for(stage: StageName, spec: JobSpec, root: Path, phantoms: Path | None) -> JobSpec:
    """The options as a stage receives them. The demonstration's mouth is the folder of kept mouths for the phantom
    stage, and the mouth that was made for this job for all others.
    """
    if spec.rig is None or not spec.is_demo:
        return spec
    mouth = (phantoms or spec.rig.mouth) if stage == "phantom" else root / PUBLISHED_AS["phantom"]
    return spec.model_copy(update={"rig": spec.rig.model_copy(update={"mouth": mouth})})


def request_cancel(root: Path) -> None:
    """Ask the process that runs the job in this folder to stop between two frames or steps.

    Raises:
        OSError: the folder takes no file, and there is no reserve.
    """
    try:
        (root / CANCEL_FLAG).touch()
    except OSError:
        # A full disk may have no room for a file, but it has one that can be renamed.
        if not (root / CANCEL_RESERVE).exists():
            raise
        (root / CANCEL_RESERVE).replace(root / CANCEL_FLAG)


def withdraw_cancel(root: Path) -> None:
    """Remove an earlier request to cancel, and make the reserve for the next; call before a job is started."""
    (root / CANCEL_FLAG).unlink(missing_ok=True)
    if root.is_dir():
        (root / CANCEL_RESERVE).touch()


def _do_nothing() -> None:
    """Let the next stage start."""


def _run_tasks(
    processes: Workers,
    count: int,
    tasks: list[StageTask],
    watch: Watch,
    before: Callable[[], None],
    is_cancelled: Callable[[], bool],
) -> None:
    """Submit each stage once the stage before has ended, follow its events, and raise the error that it raises."""
    from distributed.comm import CommClosedError

    try:
        with processes.serving(count, captures=any(task.stage == "capture" for task in tasks)) as client:
            for task in tasks:
                if task.stage != "capture":
                    before()
                follow_stage(client, processes.restart_lost, task, watch, is_cancelled)
    except (CancelledError, CommClosedError) as problem:
        raise SchedulerLostError(
            "The workers' scheduler went away; the job goes on from what it had published once it answers again."
        ) from problem


@contextmanager
def _sole_owner(root: Path) -> Iterator[None]:
    """Hold the folder's lock; the system releases it however this process ends."""
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
    """Remove the results of masks by hand that have changed since. The preparation, whose record shows that, goes last,
    so that a later run completes an interrupted removal.
    """
    for result in ("report.html", "parameters.json", "errors.json"):
        (root / result).unlink(missing_ok=True)
    for folder in ("asset", "fit", "prepared"):
        withdraw(root, folder)


@contextmanager
def _flag_damage(root: Path) -> Iterator[None]:
    # Damaged stages are not removed at once, because a person who has a copy may restore it before a retry.
    try:
        yield
    except CorruptStoreError:
        (root / DAMAGE_FLAG).touch()
        raise


def _withdraw_damaged(root: Path) -> None:
    """Remove damaged stages, so that they run again. Stages after them stay, because they were made from intact files,
    and a capture is never removed.
    """
    for stage in ("registered", "prepared", "fit", "asset"):
        try:
            require_intact(root, stage)
        except CorruptStoreError:
            withdraw(root, stage)
        except MissingStageError:
            continue
    (root / DAMAGE_FLAG).unlink()


def _claim_folder(root: Path, spec: JobSpec) -> None:
    """Write the job's options, or refuse a folder that holds the results of other options."""
    path, ignored = root / JOB_FILE, {"workers", "priority"}
    if path.exists():
        earlier = read_record(path, JobSpec)
        theirs, ours = (_options(one) for one in (earlier, spec))
        changed = sorted(name for name in ours if name not in ignored and ours[name] != theirs[name])
        if changed:
            raise InputError(
                f"Folder {root} holds a job with other options ({', '.join(changed)}); choose another folder or"
                " remove it."
            )
    write_record(path, spec)


def _options(spec: JobSpec) -> dict[str, Any]:
    # A server that lowers the limits of a rig does not turn a job into another one.
    return spec.model_dump(mode="json", exclude={"rig": set(LIMITS_OF_A_RIG)})
