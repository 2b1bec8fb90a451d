"""``python -m services.pipeline.scheduler_health tcp://HOST:PORT [FOLDER]``: whether a Dask scheduler answers, for a
container's health check.

It is a separate program, because it is started every few seconds and loads a tenth of what the ``dentine`` command
does.
"""

from __future__ import annotations

import sys
from pathlib import Path

from services.core.errors import DentineError
from services.pipeline.dask_tls import Certificates
from services.pipeline.workers import require_scheduler


def main(address: str, tls: str | None = None) -> int:
    """Connect to a scheduler and return the exit status, which is 0 if it answers.

    Args:
        address: ``tcp://HOST:PORT``.
        tls: folder of the certificates to show to the scheduler; None without TLS.
    """
    try:
        require_scheduler(address, Certificates.of(Path(tls)) if tls else None)
    except DentineError as problem:
        print(problem.message, file=sys.stderr)
        return problem.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:3]))
