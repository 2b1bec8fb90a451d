"""``dentine simulate slab``: simulate one slab or a stack of layers, given by options, and print the totals."""

from __future__ import annotations

import json
import math
import sys
from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Any

import typer

from services.core.errors import SettingsError
from services.core.files.json_text import parse_json


class SlabBoundary(StrEnum):
    """Optical boundary of a slab."""

    MATCHED = "matched"
    THIN = "thin"
    SMOOTH = "smooth"


class SlabSource(StrEnum):
    """How a slab is lit."""

    NORMAL = "normal"
    DIFFUSE = "diffuse"


def simulate_slab_command(
    alpha: Annotated[float | None, typer.Option(min=0, max=1, help="Single-scattering albedo.")] = None,
    sigma: Annotated[float | None, typer.Option(min=0, help="Extinction, per mm.")] = None,
    g: Annotated[float, typer.Option(min=-1, max=1, help="Mean cosine of the Henyey-Greenstein phase function.")] = 0.0,
    width: Annotated[float | None, typer.Option(min=0, help="Thickness, mm, or inf.")] = None,
    layers: Annotated[
        str | None,
        typer.Option(
            help=(
                "Instead of one slab: JSON list of {sigma, alpha, beta, g1, g2, thickness_mm}, first layer lit; a phase"
                " function may be "
                "table: {angles_rad, values} instead of beta, g1, g2."
            )
        ),
    ] = None,
    ior: Annotated[
        float, typer.Option(min=1, max=3, help="Index of refraction, used by boundaries thin and smooth.")
    ] = 1.0,
    boundary: Annotated[SlabBoundary, typer.Option(help="Optical boundary.")] = SlabBoundary.MATCHED,
    source: Annotated[SlabSource, typer.Option(help="Light along the normal, or diffuse.")] = SlabSource.NORMAL,
    mu_incident: Annotated[
        float, typer.Option(min=0, max=1, help="Cosine to the normal of the beam of source normal.")
    ] = 1.0,
    exit_cosines: Annotated[
        str, typer.Option(help="Also the radiance of scattered light at these cosines to the normal, as 0.1,0.5,1.")
    ] = "",
    ring_edges: Annotated[
        str,
        typer.Option(
            help=(
                "Also the scattered light that leaves between these radii about the point of entry, and beyond the"
                " last, mm, as 0.1,0.5."
            )
        ),
    ] = "",
    rel_error: Annotated[float, typer.Option(min=1e-5, max=1, help="Relative standard error to reach.")] = 1e-3,
    gradient: Annotated[
        bool, typer.Option("--gradient", help="Also the derivatives with their standard errors.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    max_seconds: Annotated[
        float, typer.Option(min=0, help="Give the result as it stands after this time, marked as not complete.")
    ] = 600.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Reflectance and transmittance of a slab by the walk that the fit uses."""
    from services.slab.simulate import simulate_slab

    stack = _read_layers(layers, {"alpha": alpha, "sigma": sigma, "width": width}, g)
    cosines, edges_mm = _numbers("--exit-cosines", exit_cosines), _numbers("--ring-edges", ring_edges)
    result = simulate_slab(
        stack, ior=ior, boundary=boundary.value, source=source.value, mu_incident=mu_incident, exit_cosines=cosines,
        ring_edges_mm=edges_mm, rel_error=rel_error, gradient=gradient, seed=seed, max_seconds=max_seconds,
        numbered=layers is not None,
    )  # fmt: skip
    if not result.complete:
        print(
            "The time ran out before every standard error was reached; the ones printed are true, give --max-seconds"
            " for smaller ones.",
            file=sys.stderr,
        )
    figures = result.as_json()
    print(json.dumps(figures) if as_json else _table(figures, cosines, edges_mm))


def _numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(number) for number in text.split(",")) if text else ()
    except ValueError as problem:
        raise SettingsError(
            f"Option {option} = {text} is not a list of numbers; separate them by commas, as 0.1,0.5,1."
        ) from problem


def _read_layers(text: str | None, slab: dict[str, float | None], g: float) -> tuple[Any, ...]:
    """The layers from ``--layers``, or the one slab from its own options.

    Raises:
        SettingsError: both or neither given, not JSON, or a wrong value; the message names it.
    """
    from pydantic import TypeAdapter, ValidationError

    from services.core.files.validation import remedied
    from services.slab.simulate import Layer

    given = [name for name, value in slab.items() if value is not None]
    if text is None:
        if missing := [f"--{name}" for name in slab if name not in given]:
            raise SettingsError(f"A slab needs {' and '.join(missing)}; give them, or --layers.")
        layers: Any = [{"sigma": slab["sigma"], "alpha": slab["alpha"], "g1": g, "thickness_mm": slab["width"]}]
    elif given:
        raise SettingsError(f"Option --layers describes the whole stack; leave out --{given[0]}.")
    else:
        try:
            layers = parse_json(text)
        except ValueError as problem:
            raise SettingsError(
                f'Option --layers is not JSON ({problem}); give a list such as \'[{{"sigma": 2, "alpha": 0.9,'
                ' "thickness_mm": 1}]\'.'
            ) from problem
    try:
        return tuple(TypeAdapter(list[Layer]).validate_python(layers))
    except ValidationError as problem:
        first = problem.errors()[0]
        raise SettingsError(
            f"Option --layers, {'.'.join(str(part) for part in first['loc']) or 'value'}: {remedied(first)}."
        ) from problem


def _table(figures: dict[str, Any], cosines: tuple[float, ...], edges_mm: tuple[float, ...]) -> str:
    """One line per total, derivative, radiance and ring, each with its standard error."""
    lines = [f"{name:<4} {figures[name]:.6f} +- {figures[f'{name}_se']:.1e}" for name in ("R", "T")]
    for name in ("dR", "dT"):
        lines += [
            f"{name}/d{wrt:<8} {value:+.5e} +- {figures[f'{name}_se'][wrt]:.1e}"
            for wrt, value in (figures.get(name) or {}).items()
        ]
    rings = [f"{low:g} to {high:g} mm" for low, high in pairwise((0.0, *edges_mm, math.inf))]
    for name, places in (("radiance", [f"at {cosine:g}" for cosine in cosines]), ("rings", rings)):
        if faces := figures[name]:
            lines += [
                f"{f'{side} {name} {place}':<24} {value:.5e} +- {error:.1e}"
                for side in ("R", "T")
                for place, value, error in zip(places, faces[side], faces[f"{side}_se"], strict=True)
            ]  # fmt: skip
    return "\n".join(lines)
