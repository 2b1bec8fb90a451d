"""The description of the REST API that is kept beside the code: ``python -m services.api.openapi`` writes it again
after a change.

Whoever changes a route sees in one file what changes for clients, and a test fails until it is written.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from services.api.app import create_app
from services.core.settings import ServerSettings

STORED = Path(__file__).with_name("openapi.json")


def describe() -> dict[str, Any]:
    """The description as the server gives it, without the version of the package."""
    with tempfile.TemporaryDirectory() as folder:
        described: dict[str, Any] = create_app(ServerSettings(data=Path(folder)), lambda *_: None).openapi()
    described["info"]["version"] = "v1"
    return described


if __name__ == "__main__":
    STORED.write_text(json.dumps(describe(), indent=1, sort_keys=True) + "\n")
