"""The description of the REST API that is kept beside the code: ``python -m services.api.openapi`` writes it again
after a change.

Whoever changes a route sees in one file what changes for clients, and a test fails until it is written.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from services.api.app import create_app
from services.core.settings import ServerSettings

STORED = Path(__file__).with_name("openapi.json")


def describe() -> dict[str, Any]:
    """The description as the server gives it, without the version of the package."""
    with tempfile.TemporaryDirectory() as folder:
        described = asyncio.run(_described(create_app(ServerSettings(data=Path(folder)), lambda *_: None)))
    described["info"]["version"] = "v1"
    return described


async def _described(app: FastAPI) -> dict[str, Any]:
    # Within its lifespan, at whose end the application closes what it opened.
    async with app.router.lifespan_context(app):
        return app.openapi()


if __name__ == "__main__":
    STORED.write_text(json.dumps(describe(), indent=1, sort_keys=True) + "\n")
