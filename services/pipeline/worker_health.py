"""Signs of life of this machine's workers: each writes a small file every few seconds, ``dentine worker-health`` reads
them.

Asking the scheduler instead would cost each check a connection and a line in its log, and would not show whether this
machine's own worker works. ``python -m services.pipeline.worker_health`` prints the same and imports nothing large.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from services.core.errors import PlatformError

SIGN_S = 5.0
"""Interval between a worker's signs of life, s."""
SILENT_S = 60.0
"""Time, s, without a sign of life after which a worker does not count; a busy machine may delay one by some seconds."""


def default_folder() -> Path:
    """Folder to which the workers of this user write."""
    return Path(tempfile.gettempdir()) / f"dentine-workers-{os.getuid()}"


@dataclass(frozen=True)
class Sign:
    """The file by which one worker gives signs of life."""

    path: Path

    @classmethod
    def of_this_process(cls) -> Sign:
        """The file of the worker in this process."""
        return cls(default_folder() / f"{os.getpid()}.json")

    def give(self, fault: str) -> None:
        """Record that the worker is connected and answers.

        Args:
            fault: sentence on what the worker was started for and cannot do; empty where there is nothing.
        """
        from services.core.store import write_atomic

        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomic(self.path, json.dumps({"fault": fault}).encode())

    def withdraw(self) -> None:
        """Remove the file, because the worker has ended."""
        self.path.unlink(missing_ok=True)


def require_healthy_workers(folder: Path | None = None) -> int:
    """Number of this machine's workers that are connected to their scheduler and can do what they were started for.

    Raises:
        PlatformError: there is none, or one of them cannot do what it was started for.
    """
    folder, since_s = folder or default_folder(), time.time() - SILENT_S
    signs = sorted(path for path in folder.glob("*.json") if path.stat().st_mtime > since_s)
    if not signs:
        raise PlatformError(
            f"No worker of this machine has been connected to its scheduler in the last {SILENT_S:g} s; read the"
            " worker's log."
        )
    if faults := [fault for sign in signs if (fault := json.loads(sign.read_bytes())["fault"])]:
        raise PlatformError(faults[0])
    return len(signs)


def main() -> int:
    """Print one sentence and return the exit status."""
    try:
        count = require_healthy_workers()
    except PlatformError as problem:
        print(f"dentine: {problem.message}", file=sys.stderr)
        return problem.exit_status
    print(f"{count} worker{'s' if count > 1 else ''} of this machine can work.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
