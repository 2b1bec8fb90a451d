"""The context of a stage: all that it sees of the job to which it belongs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic import Field

from services.core.errors import JobCancelledError
from services.core.geometry import Record

CANCEL_FLAG = "cancel"
"""Name of the file in a job's folder that asks the running stage to stop."""
StageName = Literal["phantom", "capture", "register", "prepare", "fit", "export"]


class StageEvent(Record):
    """One event of a stage, as the event table, the progress bars and the dashboard read it."""

    stage: StageName
    kind: Literal["started", "progress", "log", "step", "preview", "finished"]
    message: str = Field(default="", description="one sentence for people")
    done: float | None = Field(default=None, description="fraction of the stage done, 0 to 1")
    data: dict[str, Any] = Field(
        default_factory=dict, description="JSON values; a step carries step, loss, held_out_error, parameters"
    )


class StageContext(Protocol):
    """The context that each stage's ``run(request, context)`` is given."""

    @property
    def root(self) -> Path:
        """The job's folder; stages publish below it through ``services.core.store``."""

    @property
    def attempt(self) -> int:
        """Number of this attempt at the stage, from 1; the store refuses writes of an older attempt."""

    def report(self, event: StageEvent) -> None:
        """Report an event to everybody who follows the job."""

    def raise_if_cancelled(self) -> None:
        """Raise JobCancelledError once a cancellation was requested. Call between frames and between steps."""


def raise_if(is_cancelled: Callable[[], bool]) -> None:
    """Raise JobCancelledError once ``is_cancelled()``, which is ``exists`` of the job's flag file as a rule."""
    if is_cancelled():
        raise JobCancelledError("The job was cancelled on request; what it had published is kept.")


class LocalContext:
    """A context without a server: events go to a callback, cancel is a flag file in the job's folder."""

    def __init__(self, root: Path, attempt: int = 1, listener: Any = None) -> None:
        self.root = Path(root)
        self.attempt = attempt
        self._listener = listener

    def report(self, event: StageEvent) -> None:
        """Pass the event to the listener, if any."""
        if self._listener is not None:
            self._listener(event)

    def raise_if_cancelled(self) -> None:
        """Raise JobCancelledError once the flag file exists in the job's folder."""
        raise_if((self.root / CANCEL_FLAG).exists)
