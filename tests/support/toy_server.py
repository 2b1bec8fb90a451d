"""``python -m tests.support.toy_server SETTINGS [MODULE]``: the real server with the stages of ``toy_stages`` or of
another module, as a process that a test can kill.

Leases are short, because tests wait for them.
"""

from __future__ import annotations

import sys
from typing import get_args
from unittest.mock import patch

from services.api.server import serve
from services.core.settings import ServerSettings
from services.core.stage import StageName

LEASE_S, ROUND_S, RETRY_S = 6.0, 0.5, 0.5


def main(settings: ServerSettings, stages: str = "tests.support.toy_stages") -> None:
    """Serve with a module's stages and short leases."""
    with (
        patch("services.api.jobs.runner.LEASE_S", LEASE_S),
        patch("services.api.jobs.runner.ROUND_S", ROUND_S),
        patch("services.api.jobs.admission.RETRY_S", RETRY_S),
    ):
        serve(settings, doors={stage: f"{stages}:{stage}" for stage in get_args(StageName)})


if __name__ == "__main__":
    main(ServerSettings.model_validate_json(sys.argv[1]), *sys.argv[2:])
