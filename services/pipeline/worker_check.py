"""Whether a machine can do what a worker claims: imports what the stages need and renders a pixel, in a process of its
own.

``python -m services.pipeline.worker_check STAGES DOME`` says nothing and ends with status 0, or ends with 4 after one
sentence. What breaks an interpreter, such as a library that aborts it, so breaks no worker.
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
"""How long it may take; 1.5 s were measured, and a machine on which much else starts takes many times as long."""

CHECKS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {DOME: ("services.capture.stage:check",), STAGES: ("services.preprocess.stage:check", "services.fit.stage:check")}
)
"""By what a worker claims: ``module:function`` that raises what is missing."""


def fault_of(claims: Iterable[str], timeout_s: float = CHECK_S) -> str:
    """The sentence that says why this machine cannot do what is claimed; empty if it can. Waits for a process."""
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
    """The check of the machine that this process runs on, begun when this is made; it holds for all workers of its
    own.
    """

    def __init__(self) -> None:
        self._fault: str | None = None
        threading.Thread(target=self._look, name="worker-check", daemon=True).start()

    def condition(self) -> str:
        """That workers can run stages.

        Raises:
            PlatformError: they cannot, or it is not known yet.
        """
        if self._fault is None:
            raise PlatformError("It is being found out whether this machine can run stages; ask again in some seconds.")
        if self._fault:
            raise PlatformError(f"This machine cannot run stages: {self._fault}")
        return "This machine can run stages; workers start with the next job."

    def _look(self) -> None:
        self._fault = fault_of([STAGES])


def require(claims: Iterable[str]) -> None:
    """Import what is needed and render a pixel, in this very process.

    Raises:
        PlatformError: something is missing or does not work.
    """
    require_packages(("structlog",), "worker")  # every stage of a server's job writes log lines
    for door in (door for claim in claims for door in CHECKS[claim]):
        module, function = door.split(":")
        getattr(importlib.import_module(module), function)()


def main() -> int:
    """Check what the arguments claim; one sentence on standard error where it fails."""
    try:
        require(sys.argv[1:])
    except PlatformError as problem:
        print(problem.message, file=sys.stderr)
        return PlatformError.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
