"""``dentine bench``: benchmarks that measure speed together with its error."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import typer

from services.core.errors import InputError

_BENCHMARKS = MappingProxyType(
    {
        "jaw": "services.bench.fits.jaw:run",
        "prepare": "services.bench.preparation.run:run",
        "prepare-scale": "services.bench.preparation.scale:run",
        "slab": "services.bench.slab.forward:run",
        "slab-map": "services.bench.slab.accuracy:run",
        "slab-mie": "services.bench.slab.dispersions:run",
        "slab-novel": "services.bench.slab.novel:run",
        "slab-solvers": "services.bench.slab.solvers:run",
        "slab-stock": "services.bench.slab.stock:run",
        "slab-surface": "services.bench.slab.surface:run",
        "stability": "services.bench.stability.run:run",
        "tooth": "services.bench.fits.tooth:run",
        "transport-gradient": "services.bench.transport.gradient:run",
        "transport-lanes": "services.bench.transport.lanes:run",
        "transport-lights": "services.bench.transport.lights:run",
        "transport-skip": "services.bench.transport.skip:run",
        "transport-stack": "services.bench.transport.stack:run",
    }
)
"""Name -> ``module:function``; the function takes ``quick``, returns JSON values, and may also take ``case``,
``keep``, which stores unfinished rows, and ``state``, a folder from which a benchmark that was killed goes on."""


def bench(
    name: Annotated[str | None, typer.Argument(help="Benchmark to run, or all; without it they are listed.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Also write the result to this file, and a picture of it beside it.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A smaller case, for a check.")] = False,
    case: Annotated[str | None, typer.Option(help="Which case of a benchmark that has several.")] = None,
) -> None:
    """Measure speed with its error beside it."""
    import importlib
    import inspect

    if name is None:
        print("\n".join(_BENCHMARKS))
        return
    names = list(_BENCHMARKS) if name == "all" else [name]
    if unknown := [one for one in names if one not in _BENCHMARKS]:
        raise InputError(f"Benchmark {unknown[0]} does not exist; known are {', '.join(_BENCHMARKS)} and all.")
    modules, results = {}, {}
    for one in names:
        address, function = _BENCHMARKS[one].split(":")
        modules[one] = importlib.import_module(address)
        measure = getattr(modules[one], function)
        accepted = inspect.signature(measure).parameters
        options: dict[str, Any] = {"quick": quick}
        if case is not None:
            if "case" not in accepted:
                raise InputError(f"Benchmark {one} has only one case; leave out --case.")
            options["case"] = case
        if "keep" in accepted and json_file is not None and name != "all":
            options["keep"] = lambda rows: json_file.write_text(json.dumps(rows, indent=1) + "\n")
        if "state" in accepted and json_file is not None:
            options["state"] = json_file.with_suffix(".state")
        results[one] = measure(**options)
    text = json.dumps(results if name == "all" else results[name], indent=1)
    print(text)
    if json_file is None:
        return
    json_file.write_text(text + "\n")
    for one in names:
        _draw(
            modules[one],
            results[one],
            json_file.with_name(f"{json_file.stem}-{one}.png") if name == "all" else json_file.with_suffix(".png"),
        )


def _draw(module: Any, rows: list[dict[str, Any]], png: Path) -> None:
    """Draw a benchmark by the function ``picture`` of its module, or as error against time where it has none."""
    try:
        from services.bench.plots import error_against_time, write_png
    except ModuleNotFoundError as missing:
        print(
            f"{png} was not drawn, as {missing.name} is missing; pip install '.[bench]' in the project's folder brings"
            " it.",
            file=sys.stderr,
        )
        return
    write_png(getattr(module, "picture", error_against_time)(rows), png)
