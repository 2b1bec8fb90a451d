"""``dentine watch``: follow a job until it ends."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import typer

from services.cli.arguments import JobId, Json, Server
from services.cli.client.connection import connect
from services.core.errors import JobCancelledError

if TYPE_CHECKING:
    from services.client.client import Client


def watch(job_id: JobId, server: Server = None, as_json: Json = False) -> None:
    """Watch a job until it ends; the exit status is the job's, or 9 where its fit did not converge."""
    with connect(server) as client:
        watch_job(client, job_id, as_json=as_json)


def watch_job(client: Client, job_id: str, *, as_json: bool = False) -> None:
    """Show the progress of a job until it ends.

    Raises:
        JobCancelledError: the job was cancelled. typer.Exit: the job failed, with its exit status, or its fit did not
            converge.
    """
    from services.client.progress import ProgressView

    with ProgressView(lambda: client.get(job_id)["remaining"]) as view:
        for event in client.events(job_id):
            view(event)
    job = client.get(job_id)
    print(json.dumps(job) if as_json else shown_state(job))
    if job["state"] == "CANCELLED":
        raise JobCancelledError(f"Job {job_id} was cancelled; dentine retry {job_id} resumes it.")
    if failure := job["failure"]:
        print(f"dentine: {failure['message']}", file=sys.stderr)
        raise typer.Exit(failure["exit_status"])
    if (verdict := job["verdict"]) is not None:
        from services.cli.verdict import require_converged
        from services.core.results import Verdict

        require_converged(Verdict.model_validate(verdict))


def shown_state(job: dict[str, Any]) -> str:
    """The state of a job as the page shows it: NOT CONVERGED for a job that succeeded with a fit that did not."""
    verdict = job["verdict"]
    return "NOT CONVERGED" if verdict is not None and not verdict["converged"] else str(job["state"])
