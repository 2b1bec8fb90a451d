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
    without_photographs: Annotated[
        bool,
        typer.Option(
            "--without-photographs",
            help="Leave out every image of the person and every hash of one; without --to, in DIR/asset-without-"
            "photographs.",
        ),
    ] = False,
) -> None:
    """Write the asset and report of a finished fit again, or with --to its asset for other programs."""
    from services.core.errors import SettingsError

    if names and not to:
        raise SettingsError(f"{names[0]!r} follows the folder without --to; write --to before names of exporters.")
    from services.core.records import JOB_FILE, JobSpec
    from services.core.store import read_record

    if to:
        from services.assets.exporters import export_to

        path, wanted = out / JOB_FILE, tuple(dict.fromkeys((*to, *(names or ()))))
        spec = read_record(path, JobSpec) if path.is_file() else None
        for folder in export_to(out, wanted, spec, use=use, with_photographs=not without_photographs):
            print(f"written: {folder}")
        return
    if without_photographs:
        from services.assets.photograph_free import export_without_photographs

        print(f"written: {export_without_photographs(out, use=use)}")
        return
    if use is not None:
        raise SettingsError("--for says what files that leave are for; give it with --to or --without-photographs.")
    from services.cli.run import run_some

    run_some(("export",), read_record(out / JOB_FILE, JobSpec), out, again=True)
    print(f"report: {out / 'report.html'}")
