"""``python -m tests.support.toy_server SETTINGS [MODULE]``: the real server with toy stages, or those of another module, so that a test can kill it.

Leases are short, as tests wait for them.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from unittest.mock import patch

from services.api.dask_tls import Certificates
from services.api.events import EventAddress
from services.api.pipeline import DOORS, run_job
from services.api.server import serve
from services.api.workers import Workers
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageName

LEASE_S, ROUND_S, RETRY_S = 6.0, 0.5, 0.5


def serve_doors(settings: ServerSettings, doors: Mapping[StageName, str]) -> None:
    """Serve with these stages on real workers."""
    certificates = Certificates.of(settings.tls) if settings.tls is not None else None
    with Workers(settings.scheduler, certificates) as workers:

        def run_toys(spec: JobSpec, folder: Path, events: EventAddress) -> None:
            run_job(spec, folder, events=events, doors=doors, cluster=workers, is_logged=True)

        serve(settings, run_toys, workers)


def main(settings: ServerSettings, stages: str = "tests.support.toy_stages") -> None:
    """Serve with a module's stages and short leases."""
    with (
        patch("services.api.runner.LEASE_S", LEASE_S),
        patch("services.api.runner.ROUND_S", ROUND_S),
        patch("services.api.admission.RETRY_S", RETRY_S),
    ):
        serve_doors(settings, {stage: f"{stages}:{stage}" for stage in DOORS})


if __name__ == "__main__":
    main(ServerSettings.model_validate_json(sys.argv[1]), *sys.argv[2:])
