"""``python -m tests.load.server SETTINGS``: ``dentine serve`` as it is shipped but for the stages, which are toys."""

from __future__ import annotations

import sys

from services.core.settings import ServerSettings
from tests.load.stages import DOORS
from tests.support.toy_server import serve_doors

if __name__ == "__main__":
    serve_doors(ServerSettings.model_validate_json(sys.argv[1]), DOORS)
