"""Follow a stage in the process that submitted it: its events, its cancellation, and the death of workers."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from services.core.errors import JobCancelledError, WorkerLostError
from services.core.events import JobEvent
from services.core.placement import DOME, STAGES, rank
from services.core.stage import CANCEL_FLAG
from services.pipeline.database import retry_while_lost
from services.pipeline.event_log import EventLog
from services.pipeline.stage_task import StageTask
from services.pipeline.stopping import stop_tasks

if TYPE_CHECKING:
    from distributed import Client, Future

Listener = Callable[[JobEvent], None]

FINAL_STATUSES = ("finished", "error")
"""Final statuses of a task; a task with status lost, whose worker died with the result, runs again."""
POLL_S = 0.25
RESTART_INTERVAL_S = 10.0
"""Interval, s, at which workers that Dask has given up are started again."""
GRACE_S = 5.0
"""Time, s, within which a cancelled stage must stop before its tasks are stopped, and after which this is repeated. The
end of a capture is always awaited, because the capture darkens the dome."""


class Watch:
    """Passes new rows of the event table to the listener."""

    def __init__(self, log: EventLog, listener: Listener | None, after: int) -> None:
        self._log, self._listener, self._after = log, listener, after

    def pass_on_events(self) -> None:
        """Pass all new events to the listener."""
        while new := retry_while_lost(lambda: self._log.read(self._after)):
            for event in new:
                if self._listener is not None:
                    self._listener(event)
            self._after = new[-1].id


def never() -> bool:
    """Say that no cancel waits for disk."""
    return False


def follow_stage(
    client: Client,
    restart_lost_workers: Callable[[], None],
    task: StageTask,
    watch: Watch,
    is_cancelled: Callable[[], bool] = never,
) -> None:
    """Submit a stage, pass on its events until it has ended, and raise the error that it raises.

    Args:
        restart_lost_workers: called from time to time; starts workers again that Dask has given up.
        is_cancelled: whether the job was cancelled, though the flag in its folder may be missing for lack of disk.

    Raises:
        JobCancelledError: the stage was cancelled and did not stop in time. WorkerLostError: every worker that took on
            the stage died.
    """
    from distributed import KilledWorker

    # The key is unique, because Dask answers a key that it still knows with the old result.
    key = f"{task.stage}-{task.events.job}-{secrets.token_hex(4)}"
    needed = {DOME: 1} if task.stage == "capture" else {STAGES: 1}
    stage: Future = client.submit(task, key=key, resources=needed, priority=-rank(task.spec.priority), pure=False)
    flag, give_up_at, restart_at = task.root / CANCEL_FLAG, None, time.monotonic() + RESTART_INTERVAL_S
    try:
        final_status = None
        while final_status is None:
            final_status = _final_status(stage)
            watch.pass_on_events()
            if time.monotonic() > restart_at:
                restart_lost_workers()
                restart_at = time.monotonic() + RESTART_INTERVAL_S
            if give_up_at is None and (flag.exists() or is_cancelled()):
                give_up_at = time.monotonic() + GRACE_S
            # The task decides and not its last event, because a task that no worker takes on has no events, and the
            # capture before it has ended.
            is_grace_over = give_up_at is not None and time.monotonic() > give_up_at and task.stage != "capture"
            if final_status is None and is_grace_over:
                if stop_tasks(client, key, GRACE_S):
                    raise JobCancelledError(
                        "The job was cancelled on request; its tasks were stopped, and what it had published is kept."
                    )
                give_up_at = time.monotonic() + GRACE_S
        # The status at the task's end decides and not the present one, because a result may be lost with its worker
        # afterwards, and the task then runs again.
        if final_status != "finished":
            stage.result()
    except KilledWorker as problem:
        watch.pass_on_events()
        raise WorkerLostError(
            f"Every worker that took on stage {task.stage} died {problem.allowed_failures + 1} times; free some memory"
            " or set fewer workers, then run again.",
            {"stage": task.stage, "deaths": problem.allowed_failures + 1},
        ) from problem


def _final_status(stage: Future) -> str | None:
    """``finished`` once a task's result has arrived, or ``error``; None while the task may still end otherwise.

    Waits twice for ``POLL_S`` at most, for the end and for the result, and raises Dask's error where the scheduler was
    lost. A finished task counts as ended only once its result has arrived: its worker may die with the result, and then
    the task is lost for a while and runs again.
    """
    from distributed import wait

    try:
        wait([stage], timeout=POLL_S)
        status: str = stage.status
        if status == "finished":
            stage.result(timeout=POLL_S)
    except TimeoutError:
        return None
    return status if status in FINAL_STATUSES else None
