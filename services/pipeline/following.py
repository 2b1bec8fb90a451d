"""Follows a stage from the side of whoever submitted it: events, cancels, workers that die."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from services.core.errors import JobCancelledError, WorkerLostError
from services.core.events import JobEvent
from services.core.placement import DOME, STAGES, rank
from services.core.stage import CANCEL_FLAG
from services.pipeline.database import patiently
from services.pipeline.event_log import EventLog
from services.pipeline.stage_task import StageTask

if TYPE_CHECKING:
    from distributed import Client, Future

Listener = Callable[[JobEvent], None]

ENDS = ("finished", "error")
"""Statuses of a task that do not change by themselves; a lost one, whose worker died with the result, runs again."""
POLL_S = 0.25
KEEP_S = 10.0
"""How often workers that were given up are started again."""
GRACE_S = 5.0
"""How long a cancelled stage may take to notice before its worker is stopped. A capture is always awaited: it darkens
the dome."""


class Watch:
    """Passes new rows of the event table to the listener."""

    def __init__(self, log: EventLog, listener: Listener | None, after: int) -> None:
        self._log, self._listener, self._after = log, listener, after

    def tell(self) -> None:
        """Pass on what is new."""
        while new := patiently(lambda: self._log.read(self._after)):
            for event in new:
                if self._listener is not None:
                    self._listener(event)
            self._after = new[-1].id


def follow_stage(client: Client, keep_workers: Callable[[], None], task: StageTask, watch: Watch) -> None:
    """Submit a stage, pass on its events until it has ended, and raise what it raises.

    Args:
        keep_workers: called now and then; starts again those that were given up.

    Raises:
        JobCancelledError: it was asked to stop and did not listen. WorkerLostError: every worker that took it on died.
    """
    from distributed import KilledWorker

    key = (  # its own, as Dask answers for a key that it still knows with the old result
        f"{task.stage}-{task.events.job}-{secrets.token_hex(4)}"
    )
    needed = {DOME: 1} if task.stage == "capture" else {STAGES: 1}
    stage: Future = client.submit(task, key=key, resources=needed, priority=-rank(task.spec.priority), pure=False)
    flag, give_up_at, keep_at = task.root / CANCEL_FLAG, None, time.monotonic() + KEEP_S
    try:
        ended_as = None
        while ended_as is None:
            ended_as = _ended_as(stage)
            watch.tell()
            if time.monotonic() > keep_at:
                keep_workers()
                keep_at = time.monotonic() + KEEP_S
            if give_up_at is None and flag.exists():
                give_up_at = time.monotonic() + GRACE_S
            # By the task and not by its last event: one that no worker takes on tells of nothing, and the capture
            # before it has ended.
            is_given_up = give_up_at is not None and time.monotonic() > give_up_at and task.stage != "capture"
            if ended_as is None and is_given_up:
                _stop_workers_of(client, key)
                raise JobCancelledError(
                    "The job was cancelled on request; its workers were stopped, and what it had published is kept."
                )
        # By what it ended as, and not by what it is now: a result that is here may die with its worker, and run again.
        if ended_as != "finished":
            stage.result()
    except KilledWorker as problem:
        watch.tell()
        raise WorkerLostError(
            f"Every worker that took on stage {task.stage} died {problem.allowed_failures + 1} times; free some memory"
            " or set fewer workers, then run again.",
            {"stage": task.stage, "deaths": problem.allowed_failures + 1},
        ) from problem


def _ended_as(stage: Future) -> str | None:
    """``finished`` once a task's result is here, or ``error``; None while it may still end otherwise.

    Asks twice for ``POLL_S`` at most, for the end and for the result, and raises what Dask does where the scheduler was
    lost. A task that has finished has not ended before its result is here: its worker may die with it, and then the
    task is lost for a while and runs again.
    """
    from distributed import wait

    try:
        wait([stage], timeout=POLL_S)
        status: str = stage.status
        if status == "finished":
            stage.result(timeout=POLL_S)
    except TimeoutError:
        return None
    return status if status in ENDS else None


def _stop_workers_of(client: Client, stage: str) -> None:
    # Those that hold the stage or tasks that it has made, whose keys begin with its own. Each is started again, and
    # what another job had there runs again.
    busy = [worker for worker, keys in client.processing().items() if any(str(key).startswith(stage) for key in keys)]
    with suppress(TimeoutError):
        client.restart_workers(busy, timeout=GRACE_S)
