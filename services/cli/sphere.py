"""``dentine sphere``: from readings of an integrating sphere to absorption and reduced scattering."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from services.fit.slab.sphere.invert import Fitted


def sphere_command(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Readings: JSON of kind sphere, or an .rxt file of IAD.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of parameters.json, readings.json and translucency.json.")],
    black: Annotated[
        float, typer.Option(min=0, max=1, help="Reflectance of the black backing, for the translucency.")
    ] = 0.0,
    white: Annotated[float, typer.Option(min=0, max=1, help="Reflectance of the white backing.")] = 1.0,
) -> None:
    """Measure absorption and reduced scattering from a slab's reflectance and transmittance."""
    from services.core.errors import SettingsError
    from services.fit.slab.sphere.invert import fit_readings
    from services.fit.slab.sphere.readings import read_readings
    from services.fit.slab.sphere.translucency import translucency_of
    from services.fit.slab.sphere.write import write_sphere

    if not black < white:
        raise SettingsError(
            f"Option --black = {black:g} is not below --white = {white:g}; give the darker backing as --black."
        )
    readings = read_readings(file)
    fits = fit_readings(readings)
    translucency = translucency_of(readings, fits, black, white)
    write_sphere(out, fits, translucency)
    for fitted in fits:
        print(_line(fitted))
    for note in dict.fromkeys(note for fitted in fits for note in fitted.fit.notes):
        print(note)
    if translucency is not None:
        measured = translucency
        print(
            f"translucency parameter {measured.translucency_parameter:.2f} ± {measured.translucency_parameter_se:.2f}"
        )
        print(f"contrast ratio         {measured.contrast_ratio:.3f} ± {measured.contrast_ratio_se:.3f}")


def _line(fitted: Fitted) -> str:
    fit = fitted.fit
    quantities = [("σa", fit.sigma_a), ("σs′", fit.sigma_s_reduced)] + ([("g", fit.g)] if fit.sigma_t else [])
    values = [
        f"{label} {one.value:.4f} ±"
        f" {one.se:.4f}{' per mm' if one.unit == '1/mm' else ''}{'' if one.determined else ' (not determined)'}"
        for label, one in quantities
    ]
    return f"{fit.name}: {', '.join(values)}{'' if fit.converged else ', which does not give the readings'}"
