"""``python -m tests.support.engine_server SETTINGS MODULE``: the real server with a module's stages, its worker's memory limited by a known figure."""

from __future__ import annotations

import resource
import sys

from services.core.settings import ServerSettings
from tests.support.engine_stages import MIB
from tests.support.toy_server import main

MEMORY_BYTES = 1200 * MIB

if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_RSS, (MEMORY_BYTES, MEMORY_BYTES))  # the system knows no such limit, Dask shares it out among the processors
    main(ServerSettings.model_validate_json(sys.argv[1]), sys.argv[2])
