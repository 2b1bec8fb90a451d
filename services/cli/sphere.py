"""``dentine sphere``: from readings of an integrating sphere to absorption and reduced scattering."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from services.slab.sphere.invert import Fitted
    from services.slab.sphere.results import SphereFit, SphereQuantity

PROGRESS_S = 5.0
"""Time between two lines of progress."""


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
    from services.core.verdict import NOT_CONVERGED_STATUS
    from services.slab.sphere.invert import fitted_readings
    from services.slab.sphere.readings import read_readings
    from services.slab.sphere.translucency import translucency_of
    from services.slab.sphere.write import write_sphere

    if not black < white:
        raise SettingsError(
            f"Option --black = {black:g} is not below --white = {white:g}; give the darker backing as --black."
        )
    readings = read_readings(file)
    tell = progress(len(readings.totals))
    fits = []
    for fitted in fitted_readings(readings):
        fits.append(fitted)
        tell(len(fits))
    translucency = translucency_of(readings, fits, black, white)
    write_sphere(out, fits, translucency)
    for fitted in fits:
        print(_line(fitted))
    for note in notes_once([fitted.fit for fitted in fits]):
        print(note)
    if translucency is not None:
        measured = translucency
        print(
            f"translucency parameter {measured.translucency_parameter:.2f} ± {measured.translucency_parameter_se:.2f}"
        )
        print(f"contrast ratio         {measured.contrast_ratio:.3f} ± {measured.contrast_ratio_se:.3f}")
    if lost := [fitted.fit.name for fitted in fits if not fitted.fit.converged]:
        print(f"No slab was found for {len(lost)} of {len(fits)} readings: {_some(lost)}.", file=sys.stderr)
        raise typer.Exit(NOT_CONVERGED_STATUS)


def progress(total: int, clock: Callable[[], float] = time.monotonic) -> Callable[[int], None]:
    """A function that is told how many readings are done, and tells it on standard error every few seconds."""
    reported = clock()

    def tell(done: int) -> None:
        nonlocal reported
        if done < total and clock() - reported >= PROGRESS_S:
            reported = clock()
            print(f"{done} of {total} readings done", file=sys.stderr, flush=True)

    return tell


def notes_once(fits: list[SphereFit]) -> list[str]:
    """Each note once; those that not all readings have say which have them."""
    owners: dict[str, list[str]] = {}
    for fit in fits:
        for note in fit.notes:
            owners.setdefault(note, []).append(fit.name)
    return [note if len(names) == len(fits) else f"{_some(names)}: {note}" for note, names in owners.items()]


def _some(names: list[str]) -> str:
    """Up to four names, and how many more there are."""
    shown = ", ".join(names[:4])
    return shown if len(names) <= 4 else f"{shown} and {len(names) - 4} more"


def _line(fitted: Fitted) -> str:
    fit = fitted.fit
    quantities = [("σa", fit.sigma_a), ("σs′", fit.sigma_s_reduced)] + ([("g", fit.g)] if fit.sigma_t else [])
    if fit.absorption_ratio is not None:
        quantities.append(("σa/σs′", fit.absorption_ratio))
    values = [f"{label} {_value(one)}" for label, one in quantities]
    return f"{fit.name}: {', '.join(values)}{'' if fit.converged else _off(fit)}"


def _off(fit: SphereFit) -> str:
    pairs = [("R", fit.R_fitted, fit.R), ("T", fit.T_fitted, fit.T)]
    unlike = [f"{name} {own:.4f} and not {one:.4f}" for name, own, one in pairs if own is not None and one is not None]
    return f", which would read {', '.join(unlike)}"


def _value(one: SphereQuantity) -> str:
    if one.value is None or one.se is None:
        return "not determined"
    unit = " per mm" if one.unit == "1/mm" else ""
    return f"{one.value:.4f} ± {one.se:.4f}{unit}{'' if one.determined else ' (not determined)'}"
