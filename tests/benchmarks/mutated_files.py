"""Files mutated from good ones, read by the project and by a second parser.

python -m tests.benchmarks.mutated_files [--files 100] [--seed 1] [--keep FOLDER]

For each format it prints how many files were read the same, refused in a sentence, or unread by the second parser too.
It names every file that was read differently or ended in a traceback, and fails where there is one.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.support.mutated_files import FORMATS, outcomes


def main() -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=100, help="of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder that keeps the files with a fault")
    given = parser.parse_args()
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    faults = 0
    with tempfile.TemporaryDirectory() as scratch:
        for name in FORMATS:
            folder = (given.keep or Path(scratch)) / name
            folder.mkdir(parents=True, exist_ok=True)
            found = outcomes(name, given.files, given.seed, folder)
            counts = Counter(one.kind for one in found)
            print(f"{name}: " + ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items())))
            for one in found:
                if one.is_fault:
                    faults += 1
                    print(f"  {one.name} {one.kind}: {one.detail}")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
