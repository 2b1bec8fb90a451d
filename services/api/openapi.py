"""Writes the OpenAPI description of the REST API to ``openapi.json``: ``python -m services.api.openapi``.

Run it after every change of a route. The file shows in one place what changes for clients, and a test fails until it is
up to date.
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
    """Return the description as the server gives it, with version ``v1`` instead of the version of the package."""
    with tempfile.TemporaryDirectory() as folder:
        described = asyncio.run(_described(create_app(ServerSettings(data=Path(folder)), lambda *_: None)))
    described["info"]["version"] = "v1"
    return described


async def _described(app: FastAPI) -> dict[str, Any]:
    # Describe the application within its lifespan, at the end of which it closes what it opened.
    async with app.router.lifespan_context(app):
        return app.openapi()


if __name__ == "__main__":
    STORED.write_text(json.dumps(describe(), indent=1, sort_keys=True) + "\n")
