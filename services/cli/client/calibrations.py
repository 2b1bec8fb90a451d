"""``dentine calibrations``: list the calibrations that a server keeps."""

from __future__ import annotations

import json
from typing import Any

from services.cli.arguments import Json, Server
from services.cli.client.connection import connect


def calibrations(server: Server = None, as_json: Json = False) -> None:
    """List the calibrations of a server, newest first, each as a job's option names it."""
    with connect(server) as client:
        found = client.calibrations()
    print(json.dumps(found) if as_json else "\n".join(map(_line, found)) or "The server keeps no calibration yet.")


def _line(kept: dict[str, Any]) -> str:
    broken = f": {'; '.join(kept['broken'])}" if kept["broken"] else ""
    return f"calibrations/{kept['name']}  {kept['state']}{broken}  made {kept['made'] or 'at an unknown time'}"
