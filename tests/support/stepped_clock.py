"""``python -m tests.support.stepped_clock FILE MODULE ARGUMENTS``: a program whose clock goes ahead by as many seconds
as a file says, or behind.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path


def main(steps: Path, module: str, *arguments: str) -> None:
    """Run the module; the file may change and need not be there."""
    true_time = time.time

    def stepped() -> float:
        try:
            return true_time() + float(steps.read_text())
        except FileNotFoundError:
            return true_time()

    time.time = stepped  # before the program imports anything that keeps it
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
