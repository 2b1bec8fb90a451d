"""``dentine export``: write the asset and the report of a finished fit again, or its asset for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(
    out: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a job whose fit is published.")],
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Further exporters, after --to.")
    ] = None,
    to: Annotated[list[str] | None, typer.Option(help="Exporter of the published asset: blender, gltf, usd.")] = None,
    use: Annotated[
        str | None, typer.Option("--for", help="What the export is for, as the person's consent names it.")
    ] = None,
) -> None:
    """Write the asset and report of a finished fit again, or with --to its asset for other programs."""
    if names and not to:
        from services.core.errors import SettingsError

        raise SettingsError(f"{names[0]!r} follows the folder without --to; write --to before names of exporters.")
    if to:
        from services.assets.exporters import export_to

        for folder in export_to(out, tuple(dict.fromkeys((*to, *(names or ())))), use=use):
            print(f"written: {folder}")
        return
    from services.cli.run import run_some
    from services.core.records import JobSpec
    from services.core.store import read_record
    from services.pipeline.stages import JOB_FILE

    run_some(("export",), read_record(out / JOB_FILE, JobSpec), out, again=True)
    print(f"report: {out / 'report.html'}")
