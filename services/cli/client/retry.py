"""``dentine retry``: queue a job again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import JobId, Server
from services.cli.client.connection import connect
from services.core.errors import InputError


def retry(
    job_id: JobId,
    server: Server = None,
    flashes: Annotated[
        Path | None,
        typer.Option(metavar="JOB.toml", help="Take the acknowledgement of this file's [rig.flashes]; see Safety."),
    ] = None,
) -> None:
    """Queue a failed or cancelled job again; it resumes from what it had published."""
    acknowledged = None
    if flashes is not None:
        from services.core.settings import read_job

        rig = read_job(flashes).rig
        acknowledged = None if rig is None else rig.flashes
        if acknowledged is None:
            raise InputError(f"Job file {flashes} has no table [rig.flashes]; add it, or leave --flashes out.")
    with connect(server) as client:
        print(client.retry(job_id, acknowledged)["state"])
