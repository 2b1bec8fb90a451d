"""The server under load: requests compared to a bare route, event streams, a long queue, and a day in quick motion, as
JSON.

python -m tests.benchmarks.load --json load.json [--quick] [--only mixed,streams,queue,day]
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tests.load import day, mixed, streams, submissions

PARTS: dict[str, tuple[Callable[..., Iterable[dict[str, Any]]], dict[str, Any], dict[str, Any]]] = {
    "mixed": (
        mixed.measure,
        {"rounds": 12, "round_s": 15.0, "jobs": 1000, "fitted": 10},
        {"rounds": 2, "round_s": 4.0, "jobs": 50, "fitted": 2},
    ),
    "streams": (
        streams.measure,
        {"streams": 500, "steps": 400, "period_s": 0.05},
        {"streams": 50, "steps": 40, "period_s": 0.02},
    ),
    "queue": (submissions.measure, {"jobs": 100}, {"jobs": 5}),
    "day": (day.measure, {"quarters": day.QUARTERS_OF_A_DAY}, {"quarters": 8}),
}
"""By part: the function that measures, its full size, and its size with ``--quick``."""


def main() -> None:
    """Read the options, measure, print and write one row per point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument(
        "--quick", action="store_true", help="a few seconds each, which say whether it works, not how fast it is"
    )
    parser.add_argument("--only", default=",".join(PARTS), help="parts to measure, separated by commas")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the servers are ended too
    rows = []
    for name in options.only.split(","):
        measure, full, quick = PARTS[name]
        with tempfile.TemporaryDirectory() as work:
            for row in measure(Path(work), **(quick if options.quick else full), seed=options.seed):
                print(json.dumps(row), flush=True)
                rows.append(row)
                if options.json is not None:
                    options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
