"""Options and arguments that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: the job's.")]
JobFile = Annotated[Path, typer.Argument(metavar="JOB.toml", help="Options of the job.")]
Server = Annotated[
    str | None, typer.Option(help="Address of the server, such as http://127.0.0.1:8000; default: the settings'.")
]
JobId = Annotated[str, typer.Argument(metavar="ID", help="Id that submit printed.")]
