"""What a stage sees of the job it belongs to, and nothing more."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic import Field

from services.core.errors import JobCancelledError
from services.core.geometry import Record

CANCEL_FLAG = "cancel"
"""File in a job's folder that asks whoever works on it to stop."""
StageName = Literal["phantom", "capture", "register", "prepare", "fit", "export"]


class StageEvent(Record):
    """One thing that happened: the event table, the progress bars and the dashboard all read these."""

    stage: StageName
    kind: Literal["started", "progress", "log", "step", "preview", "finished"]
    message: str = Field(default="", description="one sentence for people")
    done: float | None = Field(default=None, description="fraction of the stage done, 0 to 1")
    data: dict[str, Any] = Field(
        default_factory=dict, description="JSON values; a step carries step, loss, held_out_error, parameters"
    )


class StageContext(Protocol):
    """Given to ``run(request, context)`` of each stage."""

    @property
    def root(self) -> Path:
        """The job's folder; stages publish below it through ``services.core.store``."""

    @property
    def attempt(self) -> int:
        """Number of this lease, from 1; the store refuses writes of an older one."""

    def report(self, event: StageEvent) -> None:
        """Tell whoever listens."""

    def raise_if_cancelled(self) -> None:
        """Raise JobCancelledError once a cancel was asked for. Call between frames and between steps."""


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
        """Raise once the flag exists in the job's folder."""
        if (self.root / CANCEL_FLAG).exists():
            raise JobCancelledError("The job was cancelled on request; what it had published is kept.")
