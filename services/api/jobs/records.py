"""Records of jobs, as the API shows them and as the runner uses them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from pydantic import Field

from services.api.auth.departures import Departure
from services.api.jobs.server_paths import without_folders
from services.api.tables.lifecycle import JobState
from services.core.errors import DentineError
from services.core.geometry import Record
from services.core.owners import DEFAULT_GROUP, Viewer
from services.core.records import JobName, JobSpec
from services.core.results import Verdict
from services.core.stage import StageName


class Failure(Record):
    """Why a job failed."""

    code: str = Field(description="stable and machine-readable")
    message: str = Field(description="one sentence that names the thing and the remedy")
    exit_status: int = Field(description="what `dentine run` would have exited with")
    stage: StageName | None = None
    evidence: dict[str, str | int | float | None] = Field(
        default={}, description="what was measured when it failed, units in the names"
    )

    @classmethod
    def of(cls, problem: DentineError, stage: StageName | None) -> Self:
        """Describe an error as the failure of a job."""
        return cls(
            code=problem.code,
            message=problem.message,
            exit_status=problem.exit_status,
            stage=stage,
            evidence=dict(problem.evidence),
        )


class Job(Record):
    """One job as the API shows it."""

    id: str
    number: int = Field(description="grows with every submission")
    state: JobState
    created_s: float = Field(description="Unix time of the submission")
    changed_s: float = Field(description="Unix time of the last change of state")
    spec: JobSpec
    failure: Failure | None
    request_id: str | None = Field(
        default=None, description="of the request that submitted it; log lines of the job carry it"
    )
    name: JobName | None = Field(default=None, description="label that a person gave it")
    owner: str = Field(default=DEFAULT_GROUP, description="group that it belongs to, or token:ID of a token in none")
    verdict: Verdict | None = Field(
        default=None,
        description=(
            "how well the fit of a job that succeeded went; null before, and where an earlier version fitted it"
        ),
    )

    def redacted_for(self, viewer: Viewer) -> Job:
        """Return the job as a viewer may see it: without the folders on the server, for one who may not use them."""
        return self if viewer.uses_paths else self.model_copy(update={"spec": without_folders(self.spec)})


class Deletion(Record):
    """The receipt of a deleted job: all that is left of it."""

    job: str
    deleted_s: float = Field(description="Unix time")
    submitted_s: float = Field(description="Unix time of the submission")
    files: int = Field(description="files that were removed")
    bytes: int
    digest: str = Field(
        description="SHA-256 over the removed files' paths, sizes and SHA-256, to compare with a copy made before"
    )
    exports: tuple[Departure, ...] = Field(
        default=(), description="what had left the server before, by the audit log; such copies are not removed"
    )

    def as_row(self) -> dict[str, Any]:
        """Columns of the table of receipts."""
        return self.model_dump() | {"exports": json.dumps([one.model_dump() for one in self.exports])}

    @classmethod
    def of_row(cls, row: Mapping[Any, Any]) -> Self:
        """The receipt of a row; those of earlier versions name no exports."""
        columns = {name: row[name] for name in cls.model_fields}
        return cls.model_validate(columns | {"exports": json.loads(row["exports"] or "[]")})


@dataclass(frozen=True)
class Creation:
    """Result of a submission: the job, and whether it is new."""

    job: Job
    is_new: bool


@dataclass(frozen=True)
class Lease:
    """The right to run a job for a while; ``number`` counts the leases of the job."""

    job: Job
    number: int
