"""The record of one event of a job, which travels from a stage to everybody who follows the job."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from services.core.geometry import Record
from services.core.stage import StageName


class JobEvent(Record):
    """One row of the event table."""

    id: int = Field(description="grows over all jobs; what Last-Event-ID names")
    job: str
    time_s: float = Field(description="Unix time")
    attempt: int = Field(description="attempt of the stage; 0 for a change of state")
    stage: StageName | None
    kind: Literal["state", "started", "progress", "log", "step", "preview", "finished"]
    message: str
    done: float | None = Field(description="fraction of the stage done, 0 to 1")
    data: dict[str, Any]
