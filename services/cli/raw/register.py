"""``dentine register``: find the pose of a raw folder's scan, and place its teeth in the rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(
    raw: Annotated[
        Path, typer.Argument(metavar="RAW", help="Folder of raw.toml with [scan] and [[landmark]] entries.")
    ],
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.json to use in place of the one that raw.toml names.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write teeth, record and pictures to; default: the raw folder.")
    ] = None,
    max_misfit_mm: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help=("Median distance of outlines beyond which the scan is refused, mm; default: 0.32."),
        ),
    ] = None,
) -> None:
    """Find where the teeth of a scan stand in the rig."""
    from services.calibrate.registration.register import MAX_MISFIT_MM, PAGE, register_folder
    from services.core.files.folders import require_folder
    from services.core.values import MAX_SQUARE_MM

    if out is not None:
        require_folder(out, "--out")
    record = register_folder(raw, calibration, out, MAX_MISFIT_MM if max_misfit_mm is None else max_misfit_mm)
    for step in record.steps:
        print(f"{step.name}: {step.points} points, {step.residual_mm:.3f} mm in the median")
        for text in step.left_out:
            print(f"  left out: {text}")
    for sentence in record.warnings:
        print(sentence)
    if record.pixel_mm is not None:
        edge = max(1, int(MAX_SQUARE_MM / record.pixel_mm))
        squares = f"a job fits squares of {edge} x {edge} pixels, {edge * record.pixel_mm:.2f} mm"
        print(f"a pixel covers {record.pixel_mm:.2f} mm at the teeth; {squares}")
    print(f"teeth: {', '.join(map(str, record.teeth))}; {record.repairs}")
    print(f"report: {(raw if out is None else out) / PAGE}")
