"""Reference results of the fit's parts for fixed seeds, stored when ``NUMERICS`` was last raised;
``python -m tests.support.golden_numerics`` stores them anew.

They are the images and derivatives of the real engine on a small tooth with stains, and every result that a short fit
on the fake engine records, which covers solvers and schedules.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from services.core.records import Boundary, JobSpec
from services.core.stage import LocalContext
from services.fit.stage import run
from services.tasks.journal import read_entries
from services.transport.numerics import NUMERICS
from tests.support.prepared import FAKE, write_prepared

STORED = Path(__file__).parents[1] / "data" / "numerics.npz"
FIT_OPTIONS = {
    "boundary": "matched",
    "dentin": "known",
    "samples_per_pixel": 64,
    "max_samples_per_pixel": 128,
    "max_steps": 4,
    "search_candidates": 500,
}
PASSING = frozenset({"begun", "seconds"})
"""Keys of the journal that depend on the clock, and are therefore left out."""


def renders() -> dict[str, NDArray[np.float32]]:
    """Render images and derivatives with the real engine, by boundary and kind; a rough surface has not all of them."""
    from services.transport.engine import Engine
    from tests.support.render_once import Picture, picture, plain_results
    from tests.support.stained_tooth import stained_recipe

    found: dict[str, NDArray[np.float32]] = {}
    for boundary in get_args(Boundary):
        engine = Engine(stained_recipe(boundary), 2)
        if boundary == "rough":
            results = plain_results(engine)
        else:
            whole = picture(engine)
            results = {field.name: getattr(whole, field.name) for field in fields(Picture)}
        found |= {f"render/{boundary}/{name}": values.astype(np.float32) for name, values in results.items()}
    return found


def fit_results(instrument: str) -> dict[str, NDArray[np.float64]]:
    """Run a short fit and return every number that it records, by the key of its result.

    Args:
        instrument: the option; "off" leaves out the instrument's errors and gives the numbers of the first numerics.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_prepared(root)
        options = {"capture": root, "instrument": instrument, **FIT_OPTIONS}
        run(JobSpec.model_validate(options), LocalContext(root), engine=FAKE)
        entries = read_entries(root / "fit-checkpoint" / "journal.jsonl")
    return {
        f"fit-{instrument}/{key}": np.array(list(_numbers(value)))
        for key, value in entries.items()
        if key not in PASSING
    }


def measure() -> dict[str, NDArray[Any]]:
    """Compute all results that the file stores, by key."""
    return {**renders(), **fit_results("on"), **fit_results("off")}


def _numbers(value: Any) -> Iterator[float]:
    match value:
        case bool() | int() | float():
            yield float(value)
        case list():
            for one in value:
                yield from _numbers(one)
        case dict():
            for name, one in sorted(value.items()):
                if name not in PASSING:
                    yield from _numbers(one)


def main() -> None:
    """Store the results of this tree, unless the file already holds results for this value of ``NUMERICS``."""
    if STORED.exists() and int(np.load(STORED)["numerics"]) >= NUMERICS:
        sys.exit(f"{STORED} holds numerics {NUMERICS}; raise services.transport.numerics.NUMERICS first.")
    np.savez_compressed(STORED, numerics=NUMERICS, **measure())  # type: ignore[arg-type]  # none is called allow_pickle
    print(f"{STORED}: {STORED.stat().st_size} bytes")


if __name__ == "__main__":
    main()
