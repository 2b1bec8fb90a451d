"""``dentine demo``: the demonstration, here or on a server."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import Json
from services.cli.client.connection import connect
from services.cli.client.watch import watch_job


def demo(
    server: Annotated[
        str | None,
        typer.Option(
            help="Server to run it on, such as http://127.0.0.1:8000; default: this machine, without a server."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder of the results, where no server is given; the same folder goes on with it.")
    ] = Path("demo"),
    name: Annotated[str, typer.Option(help="Label of the job on the server.")] = "Demonstration",
    as_json: Json = False,
) -> None:
    """Run the demonstration: a simulated dome lights a virtual incisor, and a fit of its red, green and blue finds its
    optics; some minutes on two cores. Without a server it ends with a photograph beside the asset's render in colour.
    """
    from services.api.presets import find_preset
    from services.core.records import JobSpec

    spec = JobSpec.model_validate(find_preset("demo").options)
    if server is None:
        from services.cli.client.demo_end import tell_end
        from services.cli.run import run_to_asset

        tell_end(run_to_asset(spec, out, None), out, as_json=as_json)
        return
    with connect(server) as client:
        job_id = client.submit(spec, name=name)["id"]
        print(f"job: {job_id}", file=sys.stderr)
        watch_job(client, job_id, as_json=as_json)
    if not as_json:
        print(f"report: {server.rstrip('/')}/v1/jobs/{job_id}/artifacts/report.html")
