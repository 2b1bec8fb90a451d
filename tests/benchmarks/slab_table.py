"""Every value of the slab tables with its error, z-score and cost, as JSON rows.

python -m tests.benchmarks.slab_table derivatives --passes 3 --json slab_derivatives.json
python -m tests.benchmarks.slab_table derivatives --cases S01,S02 --seconds 600 --json slab_derivatives.json
python -m tests.benchmarks.slab_table totals --passes 4 --json slab_totals.json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.slab.simulate import Sums
from tests.support.slab_tables import SlabCase, derivative_cases, is_costly, named, passes, simulate, total_cases

DEEP_TOLERANCE = 1e-3
"""Tolerance of totals where a path scatters hundreds of times, because a smaller one takes hours there."""


def tolerances(case: SlabCase, of_totals: float) -> NDArray[np.float64]:
    """Tolerance (rows, 2) of each value."""
    totals = np.full((1, 2), of_totals)
    return np.vstack([totals, case.derivative_tolerance()]) if case.names else totals


def rule(tolerance: NDArray[np.float64], seconds: float) -> Callable[[Sums], float]:
    """A shortfall function: the largest standard error over a third of its tolerance, and 0 once the time is up."""
    allowed, begun_s = tolerance / 3, time.monotonic()
    return lambda sums: float((sums.standard_error() / allowed).max()) if time.monotonic() < begun_s + seconds else 0.0


def measure(
    case: SlabCase, tolerance: NDArray[np.float64], shortfall: Callable[[Sums], float], seed: int
) -> Iterator[dict[str, object]]:
    """Yield one row per value; ``reached`` is its standard error over a third of its tolerance, so that 1 or less
    fulfils the rule.
    """
    began = time.perf_counter()
    sums = simulate(case, shortfall, seed)
    seconds = time.perf_counter() - began
    mean, error = sums.mean(), sums.standard_error()
    for row, name in enumerate(("total", *case.names)):
        for column, side in enumerate("RT"):
            value, truth, spread = mean[row, column], case.values[row, column], error[row, column]
            yield {
                "case": case.name,
                "boundary": case.boundary,
                "value_of": f"{side} {name}",
                "value": value,
                "reference": truth,
                "se": spread,
                "z": (value - truth) / spread if spread > 0 else 0.0,
                "reached": 3 * spread / tolerance[row, column],
                "paths": sums.samples,
                "seconds": round(seconds, 2),
            }


def main() -> None:
    """Write one table and print its summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("derivatives", "totals"))
    parser.add_argument("--passes", type=int, default=2, help="of 262144 paths, each next one up to four times as long")
    parser.add_argument(
        "--seconds", type=float, help="instead of passes: until a third of every tolerance, at most so long per case"
    )
    parser.add_argument(
        "--tolerance", type=float, default=1e-3, help="of totals, absolute; of the deepest white slabs at least 1e-3"
    )
    parser.add_argument("--cases", help="only these, separated by commas; a first word, as S01")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    cases = derivative_cases() if arguments.table == "derivatives" else total_cases()
    if arguments.cases:
        cases = named(cases, *arguments.cases.split(","))
    rows: list[dict[str, object]] = []
    for number, case in enumerate(cases):
        tolerance = tolerances(
            case, max(arguments.tolerance, DEEP_TOLERANCE) if is_costly(case) else arguments.tolerance
        )
        shortfall = rule(tolerance, arguments.seconds) if arguments.seconds else passes(arguments.passes)
        rows += measure(case, tolerance, shortfall, arguments.seed + number)
        arguments.json.write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n")
    z = np.array([row["z"] for row in rows], dtype=np.float64)
    fulfilled = sum(float(str(row["reached"])) <= 1 for row in rows)
    print(
        f"{len(rows)} values: rms z {np.sqrt(np.mean(z**2)):.3f}, largest |z| {np.abs(z).max():.2f}, {fulfilled} at a"
        " third of their tolerance"
    )


if __name__ == "__main__":
    main()
