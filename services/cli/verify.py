"""``dentine verify``: whether an exported asset is as it was written, and whether other programs take it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import Json

FAILED_STATUS = 3
"""Exit status where a program of others finds a fault; that of an asset that was edited is the same."""


def verify(
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Folder of a job, or of one exported asset of it.")],
    clients: Annotated[
        str, typer.Option(help="Python with further modules to check by, such as bpy, pxr and MaterialX.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Check that an asset was not edited by hand, and open its files with each validator and program that is here."""
    from services.assets.verification import verify as checks

    found = [one for folder in checks.exported_folders(asset) for one in checks.verify(folder, clients)]
    if as_json:
        print(json.dumps([asdict(one) | {"folder": str(one.folder)} for one in found]))
    else:
        for one in found:
            print(f"{one.state}: {one.folder.name}: {one.what}")
            for finding in one.findings:
                print(f"  {finding}")
    if any(one.state == "failed" for one in found):
        raise typer.Exit(FAILED_STATUS)
