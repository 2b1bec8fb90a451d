"""``dentine import``: a folder of named photographs as a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def import_command(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Photographs named CAMERA_LIGHT_EXPOSURE, such as left_L07_0.05s.tif."),
    ],
    exposure_s: Annotated[
        float | None, typer.Option(min=1e-9, help="Exposure of files whose names say none, seconds.")
    ] = None,
    mosaic: Annotated[
        str | None, typer.Option(help="Mosaic of cameras whose files hold one number a pixel: RGGB, BGGR, GRBG, GBRG.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="calibration.json of the rig.")] = None,
    ignore: Annotated[
        list[str] | None, typer.Option(metavar="WORD", help="Word of file names without a meaning; may be repeated.")
    ] = None,
) -> None:
    """Write raw.toml for a folder of named photographs, and say what is missing."""
    from services.capture.raw.importing import import_folder
    from services.core.raw.folder import DESCRIPTION

    imported = import_folder(folder, exposure_s, mosaic, calibration, ignore or ())
    cameras, lights, frames = (
        len(one) for one in (imported.folder.camera, imported.folder.light, imported.folder.frame)
    )
    print(f"{folder / DESCRIPTION}: {frames} frames of {cameras} cameras under {lights} lights")
    for sentence in imported.missing:
        print(sentence)
