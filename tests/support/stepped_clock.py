"""``python -m tests.support.stepped_clock FILE MODULE ARGUMENTS``: run a program whose clock is ahead by the number of
seconds in a file, or behind if it is negative.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path


def main(steps: Path, module: str, *arguments: str) -> None:
    """Run the module; the file may change meanwhile, and the clock is true while the file is missing."""
    true_time = time.time

    def stepped() -> float:
        try:
            return true_time() + float(steps.read_text())
        except FileNotFoundError:
            return true_time()

    time.time = stepped  # before the program imports modules that store a reference to it
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
