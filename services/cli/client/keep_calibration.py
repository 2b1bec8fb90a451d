"""``dentine keep-calibration``: give a calibration that a job made a name."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from services.cli.arguments import JobId, Json, Server
from services.cli.client.connection import connect


def keep_calibration(
    job_id: JobId,
    name: Annotated[str, typer.Argument(help="1 to 60 letters, digits, '.', '_', '-'; such as the rig and a date.")],
    server: Server = None,
    as_json: Json = False,
) -> None:
    """Put what a calibration job made under a name, for jobs to use; prints the name's state."""
    with connect(server) as client:
        kept = client.keep_calibration(job_id, name)
    print(json.dumps(kept) if as_json else f"calibrations/{kept['name']}: {kept['state']}")
