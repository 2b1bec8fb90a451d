"""``dentine reproduce``: make an asset again from its inputs, and say whether the numbers are the same."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.arguments import Workers

if TYPE_CHECKING:
    from services.core.records import JobSpec

DIFFERS_STATUS = 1
"""Exit status where inputs or numbers differ."""


def reproduce(
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Folder of a job, or its folder asset.")],
    capture: Annotated[
        Path | None, typer.Option(help="Capture that it was made from; default: the one that the job's folder names.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="Calibration of the job, likewise.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder of the second run; default: one that is removed at the end.")
    ] = None,
    workers: Workers = None,
) -> None:
    """Make an asset again from its inputs, and say whether all numbers are the same, or what differs."""
    from services.assets.provenance.reproduction import (
        changed_inputs,
        changed_machine,
        changed_results,
        job_again,
        open_asset,
    )

    first = open_asset(asset)
    spec = job_again(first, capture, calibration)
    with tempfile.TemporaryDirectory(prefix="dentine-reproduce-") as place:
        again = _new_folder(out, Path(place) / "again")
        if (first.job / "masks").is_dir():
            shutil.copytree(first.job / "masks", again / "masks")
        if found := changed_inputs(first, spec, again):
            print("\n".join(found))
            print("The inputs differ, so nothing was run.")
            raise typer.Exit(DIFFERS_STATUS)
        if first.provenance.inputs is None:
            print("An earlier version prepared this asset and listed no inputs, so they cannot be compared.")
        for line in changed_machine(first):
            print(line)
        _run(spec, again, workers)
        count, found = changed_results(first.folder, again / "asset")
    if found:
        print("\n".join(found))
        print(f"{len(found)} of {count} numbers and surfaces differ.")
        raise typer.Exit(DIFFERS_STATUS)
    print(f"All {count} numbers and surfaces are equal to the last digit.")


def _new_folder(out: Path | None, otherwise: Path) -> Path:
    from services.core.errors import InputError

    if out is not None and out.exists() and any(out.iterdir()):
        raise InputError(f"Folder {out} is not empty; name a new one by --out.")
    folder = out or otherwise
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _run(spec: JobSpec, folder: Path, workers: int | None) -> None:
    from services.cli.run import cancelling_on_signals, require_apart
    from services.client.progress import ProgressView
    from services.pipeline.stages import run_job

    require_apart(spec, folder)
    with cancelling_on_signals(folder), ProgressView() as view:
        run_job(spec, folder, view, workers)
    print("Made again; comparing.", file=sys.stderr)
