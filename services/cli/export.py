"""``dentine export``: write the asset and the report of a finished fit again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(out: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a job whose fit is published.")]) -> None:
    """Write the asset and report of a finished fit again."""
    from services.cli.run import run_some
    from services.core.records import JobSpec
    from services.core.store import read_record
    from services.pipeline.stages import JOB_FILE

    run_some(("export",), read_record(out / JOB_FILE, JobSpec), out, again=True)
    print(f"report: {out / 'report.html'}")
