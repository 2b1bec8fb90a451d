"""``dentine lab-demo``: a virtual laboratory, from its raw frames to a measured tooth."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import Json, Workers


class KnownName(StrEnum):
    """The part of the truth that a comparison is given."""

    PERFECT = "perfect"
    POSE = "true pose"
    CAMERAS = "true cameras"
    LIGHTS = "true lights"
    RADIOMETRY = "true radiometry"


def lab_demo(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the laboratory; what is there and whole is kept, and a run that was ended goes on."
        ),
    ] = Path("lab"),
    coarse: Annotated[bool, typer.Option("--coarse", help="Small images, few paths and a first look's fit.")] = False,
    subject: Annotated[int, typer.Option(min=0, help="Whose teeth: a number draws shapes and optics.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Draws the rig's errors, the noise and the clicks.")] = 1,
    compare: Annotated[
        list[KnownName] | None,
        typer.Option(
            help="Fit the same photographs with this much of the truth given; default: perfect. May be repeated."
        ),
    ] = None,
    frames_only: Annotated[bool, typer.Option("--frames-only", help="Make the laboratory's frames and stop.")] = False,
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Make a virtual laboratory's raw frames once, measure a tooth from them alone, and compare it with the truth."""
    from services.bench.lab.chain import remove_results
    from services.bench.lab.run import measured
    from services.bench.lab.summary_page import PAGE, lines, write_summary
    from services.core.files.folders import require_folder
    from services.phantom.lab.make import COARSE_SIZE, DEMO_SIZE, make_lab

    require_folder(out, "--out")
    size = COARSE_SIZE if coarse else DEMO_SIZE
    if make_lab(out, size, subject, seed, _log):
        remove_results(out)
    if frames_only:
        print(f"laboratory: {out}")
        return
    summary = measured(
        out, size.rig.pixel_mm, [one.value for one in compare or [KnownName.PERFECT]], workers, _log, coarse=coarse
    )
    write_summary(out, summary)
    print(json.dumps(summary) if as_json else "\n".join([*lines(summary), f"report: {out / PAGE}"]))


def _log(what: str) -> None:
    print(what, file=sys.stderr, flush=True)
