"""``python -m tests.support.toy_server DATA``: the real server with toy stages, so that a test can kill it."""

from __future__ import annotations

import sys
from pathlib import Path

from services.api.events import EventAddress
from services.api.pipeline import run_job
from services.api.server import serve
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from tests.support.toy_stages import DOORS


def run_toys(spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Run a job with toy stages on real workers."""
    run_job(spec, folder, events=events, doors=DOORS, is_logged=True)


if __name__ == "__main__":
    serve(ServerSettings(port=0, data=Path(sys.argv[1])), run_toys)
