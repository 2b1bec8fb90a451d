"""``python -m services.slab FOLDER --out DIR``: fit a slab folder and print the results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from services.core.errors import DentineError, SettingsError
from services.core.files.validation import remedied
from services.core.results import Figure
from services.core.slab.dictionaries import DEFAULT_DICTIONARY, DICTIONARIES
from services.core.verdict import NOT_CONVERGED_STATUS, percent


def main(
    folder: Annotated[Path, typer.Argument(help="Folder with slab.json and its images.")],
    out: Annotated[Path, typer.Option(help="Where parameters.json, phase.json and errors.json go.")],
    seed: Annotated[int, typer.Option(min=0, help="Random seed; the same seed gives the same answer.")] = 1,
    effort: Annotated[float, typer.Option(min=0.01, help="Paths, in units of the default budget.")] = 1.0,
    dictionary: Annotated[str, typer.Option(help=f"One of {', '.join(DICTIONARIES)}.")] = DEFAULT_DICTIONARY,
    particle_index: Annotated[float | None, typer.Option(help="Of dictionary mie: index of the particles.")] = None,
    particle_absorption: Annotated[float, typer.Option(min=0, help="Its imaginary part.")] = 0.0,
) -> None:
    """Measure a material's scattering from images of a cell."""
    from services.slab.fit import fit_slab, write_results
    from services.slab.options import SlabOptions
    from services.slab.results.result import SlabReport

    try:
        try:
            options = SlabOptions(
                seed=seed,
                effort=effort,
                dictionary=dictionary,
                particle_index=particle_index,
                particle_absorption=particle_absorption,
            )
        except ValidationError as problem:
            raise SettingsError(f"{remedied(problem.errors()[0])}.") from problem
        fits = fit_slab(folder, options)
    except DentineError as error:
        print(error, file=sys.stderr)
        raise typer.Exit(error.exit_status) from error
    write_results(fits, out)
    for fit in fits:
        fit_error = percent(Figure(value=fit.errors.fit_error, se=fit.errors.fit_error_se))
        print(f"{fit.wavelength_nm:g} nm, {fit.core_seconds:.0f} core-seconds, fit error {fit_error}")
        quantities = {name: getattr(fit.parameters, name) for name in type(fit.parameters).model_fields}
        for name, quantity in (quantities | {name: atom for name, atom in fit.atoms.items() if atom.value > 0}).items():
            print(
                f"  {name:22} {quantity.value:9.5f} {f'± {quantity.se:.5f}' if quantity.se else 'given':9}"
                f" {quantity.unit}{'' if quantity.determined else '  not determined'}"
            )
        for note in fit.notes:
            print(f"  {note}")
    verdict = SlabReport(fits=tuple(fits)).verdict()
    if not verdict.converged:
        print(f"{verdict.headline} {verdict.advice}".rstrip(), file=sys.stderr)
        raise typer.Exit(NOT_CONVERGED_STATUS)


if __name__ == "__main__":
    typer.run(main)
