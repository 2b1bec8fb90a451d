"""``dentine download``: all files of a job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import JobId, Server
from services.cli.client.connection import connect
from services.core.errors import InputError


def download(
    job_id: JobId,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.zip", help="Where to write it; default: dentine-ID.zip here.")
    ] = None,
    server: Server = None,
) -> None:
    """Download all files of a job as one zip: report, parameters, asset and pictures."""
    target = out or Path(f"dentine-{job_id}.zip")
    if target.is_dir():
        raise InputError(f"{target} is a folder; name the zip file to write with --out.")
    with connect(server) as client:
        client.download(job_id, target)
    print(target)
