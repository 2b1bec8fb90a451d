"""Figures of teeth 2018 by this project's own fits: ``python -m services.bench.figures --out DIR``.

Each figure is a PNG with a text file of its caption beside it, and ``index.html`` shows all figures in the folder.
Captures and fits are made once, by the command line, and kept below ``DIR/work``; finished ones are used again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

from services.bench.figures.ambient import under_ambient_light
from services.bench.figures.drawings import (
    Drawn,
    caption_page,
    five_lights,
    front_and_side,
    stages,
    unseen_camera,
    whole_jaw,
)
from services.bench.figures.environment import memorial, under_an_environment
from services.bench.figures.figure_cases import FULL, QUICK, FigureCases
from services.bench.fits.tooth_capture import real_tooth
from services.core.errors import DentineError, InputError
from services.core.pages.pictures import png_bytes
from services.core.store import write_atomic

Drawing = Callable[[FigureCases], Drawn]

FIGURES: Mapping[str, Drawing] = MappingProxyType(
    {
        "fig8": front_and_side,
        "fig9": stages,
        "fig10": five_lights,
        "fig11": partial(whole_jaw, subject=1),
        "fig12": partial(whole_jaw, subject=2),
        "fig13": unseen_camera,
        "environment": under_an_environment,
        "ambient": under_ambient_light,
    }
)
"""Functions that draw the figures, by the figure's name; numbers are those of teeth 2018."""


def chosen_figures(names: str | None) -> tuple[str, ...]:
    """Return the figures of a list of names with commas, in the order of the paper; all figures without a list.

    Raises:
        InputError: a figure does not exist, or the list is empty.
    """
    requested = tuple(FIGURES) if names is None else tuple(filter(None, (name.strip() for name in names.split(","))))
    for name in requested:
        if name not in FIGURES:
            raise InputError(f"Figure '{name}' does not exist; known are {', '.join(FIGURES)}.")
    if not requested:
        raise InputError(f"Option --only names no figure; known are {', '.join(FIGURES)}.")
    return tuple(name for name in FIGURES if name in requested)


def write_figure(folder: Path, name: str, drawn: Drawn) -> None:
    """Write a figure and its caption, and the page of all figures in the folder."""
    write_atomic(folder / f"{name}.png", png_bytes(drawn.picture))
    write_atomic(folder / f"{name}.txt", (drawn.caption + "\n").encode())
    present = [
        (one, (folder / f"{one}.txt").read_text().strip()) for one in FIGURES if (folder / f"{one}.txt").is_file()
    ]
    write_atomic(folder / "index.html", caption_page(present).encode())


def main(arguments: list[str] | None = None) -> int:
    """Make the figures that the command line's arguments name, and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m services.bench.figures", description=(__doc__ or "").split("\n\n", maxsplit=1)[0]
    )
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder of the figures (default: figures)")
    parser.add_argument("--only", metavar="NAMES", help=f"some of {', '.join(FIGURES)}, with commas (default: all)")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="smaller captures of the procedural incisor and fits of few samples, for a check",
    )
    options = parser.parse_args(arguments)
    try:
        names, cases = (
            chosen_figures(options.only),
            FigureCases(
                QUICK if options.quick else FULL, options.out / "work", None if options.quick else real_tooth()
            ),
        )
        cases.work.mkdir(parents=True, exist_ok=True)
        for name in names:
            if name == "environment" and memorial() is None:
                print(
                    "environment: skipped, because hdr-memorial does not lie in shared/data beside the checkout.",
                    flush=True,
                )
                continue
            write_figure(options.out, name, FIGURES[name](cases))
            print(options.out / f"{name}.png", flush=True)
    except DentineError as problem:
        print(f"figures: {problem.message}", file=sys.stderr)
        return problem.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
