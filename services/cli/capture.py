"""``dentine capture``: only the capture of a job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import JobFile
from services.core.errors import InputError


def capture(job: JobFile, out: Annotated[Path, typer.Option(help="Folder of the job.")]) -> None:
    """Run only the capture of a job that names a rig."""
    from services.cli.run import require_apart, run_some
    from services.core.settings import read_job

    spec = read_job(job)
    if spec.rig is None:
        raise InputError(f"Job file {job} names no rig to capture with; give it a [rig] table.")
    require_apart(spec, out)
    run_some(("phantom", "capture") if spec.is_demo else ("capture",), spec, out, again=False)
    print(f"capture: {out / 'capture'}")
