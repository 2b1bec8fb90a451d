"""Check whether a machine can do what a worker claims: import what the stages need and render a pixel, in a separate
process.

``python -m services.pipeline.worker_check STAGES DOME`` prints nothing and ends with status 0, or prints one sentence
and ends with status 4. So a fault that ends the interpreter, such as a library that aborts it, ends no worker.
"""

from __future__ import annotations

import importlib
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from services.core.errors import PlatformError
from services.core.installed import require_packages
from services.core.placement import DOME, STAGES

CHECK_S = 120.0
"""Longest time of the check, s; 1.5 s were measured, and a machine on which many other programs start takes many times
as long."""

CHECKS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        DOME: ("services.capture.stage:check",),
        STAGES: ("services.preprocess.stage:check", "services.fit.stage:check", "services.assets.stage:check"),
    }
)
"""Resource that a worker claims -> ``module:function`` of the checks, which raise an error for what is missing."""


def fault_of(claims: Iterable[str], timeout_s: float = CHECK_S) -> str:
    """Check the claims in a separate process; return the sentence that says why one fails, empty where none fails."""
    command = [sys.executable, "-m", "services.pipeline.worker_check", *claims]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)  # noqa: S603
    except subprocess.TimeoutExpired:
        return (
            f"The check of what is installed did not end within {timeout_s:g} s; look for what keeps this machine busy."
        )
    if ended.returncode == 0:
        return ""
    last = next((line for line in reversed(ended.stderr.splitlines()) if line.strip()), "")
    if ended.returncode == PlatformError.exit_status:
        return last
    how = (
        f"was ended by {signal.Signals(-ended.returncode).name}"
        if ended.returncode < 0
        else f"ended with status {ended.returncode}"
    )
    return f"The process that imports what stages need and renders a pixel {how}: {last or 'it said nothing'}."


class OwnCheck:
    """The check of this process's machine, which starts with the object; it holds for all workers of this process."""

    def __init__(self) -> None:
        self._fault: str | None = None
        threading.Thread(target=self._run, name="worker-check", daemon=True).start()

    def condition(self) -> str:
        """A sentence which says that workers can run stages.

        Raises:
            PlatformError: they cannot, or the check has not ended yet.
        """
        if self._fault is None:
            raise PlatformError("It is being found out whether this machine can run stages; ask again in some seconds.")
        if self._fault:
            raise PlatformError(f"This machine cannot run stages: {self._fault}")
        return "This machine can run stages; workers start with the next job."

    def _run(self) -> None:
        self._fault = fault_of([STAGES])


def require(claims: Iterable[str]) -> None:
    """Import what the claims need and render a pixel, in this process.

    Raises:
        PlatformError: something is missing or does not work.
    """
    require_packages(("structlog",), "worker")  # every stage of a server's job writes log lines
    for door in (door for claim in claims for door in CHECKS[claim]):
        module, function = door.split(":")
        getattr(importlib.import_module(module), function)()


def main() -> int:
    """Check what the arguments claim; print one sentence on standard error where that fails."""
    try:
        require(sys.argv[1:])
    except PlatformError as problem:
        print(problem.message, file=sys.stderr)
        return PlatformError.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
