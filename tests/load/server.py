"""``python -m tests.load.server SETTINGS``: ``dentine serve`` as it is shipped but for the stages, which are toys."""

from __future__ import annotations

import sys

from services.api.server import serve
from services.core.settings import ServerSettings
from tests.load.stages import DOORS

if __name__ == "__main__":
    serve(ServerSettings.model_validate_json(sys.argv[1]), doors=DOORS)
