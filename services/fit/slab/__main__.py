"""``python -m services.fit.slab FOLDER --out DIR``: fit a slab folder and print what came out."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from services.core.errors import DentineError


def main(
    folder: Annotated[Path, typer.Argument(help="Folder with slab.json and its images.")],
    out: Annotated[Path, typer.Option(help="Where parameters.json, phase.json and errors.json go.")],
    seed: Annotated[int, typer.Option(min=0, help="Random seed; the same seed gives the same answer.")] = 1,
    effort: Annotated[float, typer.Option(min=0.001, help="Paths, in units of the default budget.")] = 1.0,
) -> None:
    """Measure a material's scattering from images of a cell."""
    from services.fit.slab.fit import SlabOptions, fit_slab, write_results

    try:
        fits = fit_slab(folder, SlabOptions(seed=seed, effort=effort))
    except DentineError as error:
        print(error, file=sys.stderr)
        raise typer.Exit(error.exit_status) from error
    write_results(fits, out)
    for fit in fits:
        print(
            f"{fit.wavelength_nm:g} nm, {fit.core_seconds:.0f} core-seconds, fit error {100 * fit.errors.fit_error:.2f} %"
        )
        for name in type(fit.parameters).model_fields:
            told = getattr(fit.parameters, name)
            print(
                f"  {name:16} {told.value:9.5f} ± {told.se:.5f} {told.unit}{'' if told.determined else '  not determined'}"
            )
        for note in fit.notes:
            print(f"  {note}")


if __name__ == "__main__":
    typer.run(main)
