"""Run a module as a process that ends when its parent does, however that ends.

``python -m services.phantom.end_with_parent MODULE ARGUMENTS`` runs the module as ``python -m MODULE ARGUMENTS`` does.
Its standard input is a pipe that the parent holds open and writes nothing to. When the parent is gone, even by SIGKILL,
the system closes the pipe, and this process ends at once without cleaning up.
"""

from __future__ import annotations

import os
import runpy
import sys
import threading
from collections.abc import Sequence


def command(module: str, arguments: Sequence[str]) -> list[str]:
    """Command line of a Python process that runs ``module`` and ends with its parent; give it a pipe as its input."""
    return [sys.executable, "-m", "services.phantom.end_with_parent", module, *arguments]


def _end_at_eof() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_at_eof, name="end with parent", daemon=True).start()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
