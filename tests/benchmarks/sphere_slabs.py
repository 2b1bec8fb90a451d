"""Check of the integrating sphere's inversion: slabs drawn at random, whose readings it is given, must be found.

python -m tests.benchmarks.sphere_slabs --slabs 2000 --seed 1 --json sphere_slabs.json

Seven minutes of one core with 2,000 slabs. Readings are those of the forward model, so each slab lies in its range.
Whether the readings determine a slab is computed at the truth, without the search. Of those that they determine,
``missed`` and ``open`` must be none but where another slab reads the same (``ambiguous``). Of all others, each one must
be ``open``. The command ends with status 1 where one is not as it must be.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.drawn_slabs import Drawn, is_determined, outcome, random_slab


def judged(slab: Drawn) -> tuple[str, dict[str, Any]]:
    """What became of a slab, and its record."""
    what, fit = outcome(slab)
    is_known = is_determined(slab)
    if what == "open" and fit.other_slabs:
        what = "ambiguous"
    reading = slab.file.totals[0]
    record = {
        "what": what,
        "determined": is_known,
        "index": slab.file.cell.index,
        "glass": slab.file.cell.glass is not None,
        "depth": slab.optics.extinction_per_mm * slab.file.cell.width_mm,
        "g": slab.optics.g,
        "sigma_a": slab.coefficients[0],
        "sigma_s_reduced": slab.coefficients[1],
        "R": reading.R,
        "T": reading.T,
        "T_unscattered": reading.T_unscattered,
        "fit": fit.model_dump(exclude={"notes"}),
    }
    return f"{'determined' if is_known else 'not determined'}: {what}", record


def main() -> int:
    """Draw slabs, invert their readings, and count what became of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slabs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.seed)
    counts: Counter[str] = Counter()
    wrong = []
    begun = time.process_time()
    for _ in range(arguments.slabs):
        what, record = judged(random_slab(random))
        counts[what] += 1
        if what in {"determined: missed", "determined: open", "not determined: missed", "not determined: found"}:
            wrong.append(record)
    result = {
        "slabs": arguments.slabs,
        "seed": arguments.seed,
        "counts": dict(sorted(counts.items())),
        "core_minutes": round((time.process_time() - begun) / 60, 1),
        "wrong": wrong,
    }
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1))
    print(json.dumps({key: value for key, value in result.items() if key != "wrong"}, indent=1))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
