"""The server that a command speaks to."""

from __future__ import annotations

import os

from services.client.client import Client
from services.core.settings import read_settings


def connect(server: str | None) -> Client:
    """A client of the server that was named, else of the settings' one."""
    settings = read_settings(os.environ)
    return Client(server or f"http://{settings.server.host}:{settings.server.port}", settings.client.token)
