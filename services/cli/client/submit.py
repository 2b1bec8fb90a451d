"""``dentine submit``: hand a job to a server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import JobFile, Json, Server
from services.cli.client.connection import connect
from services.cli.client.watch import watch_job


def submit(
    job: JobFile,
    server: Server = None,
    send: Annotated[
        bool, typer.Option("--upload", help="Upload the job's capture, or its rig's mouth, first.")
    ] = False,
    calibration: Annotated[
        str | None, typer.Option(metavar="NAME", help="Calibration that the server stores, in place of the job's own.")
    ] = None,
    key: Annotated[
        str | None, typer.Option(help="Idempotency key; submitting twice with one key makes one job.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Label of the job, up to 80 characters.")] = None,
    follow: Annotated[bool, typer.Option("--watch", help="Watch the job until it ends.")] = False,
    as_json: Json = False,
) -> None:
    """Submit a job to a server."""
    from services.core.settings import read_job

    spec = read_job(job)
    with connect(server) as client:
        if send:
            from services.cli.client.upload import with_uploaded_source

            spec = with_uploaded_source(client, spec)
        if calibration is not None:
            spec = spec.model_copy(update={"calibration": Path(client.calibration(calibration)["option"])})
        created = client.submit(spec, key, name)
        print(json.dumps(created) if as_json else created["id"])
        if follow:
            watch_job(client, created["id"])
