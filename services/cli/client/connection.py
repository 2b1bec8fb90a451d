"""The connection of a command to its server."""

from __future__ import annotations

import os

from services.client.client import Client
from services.core.settings import read_settings


def connect(server: str | None) -> Client:
    """A client of the given server, or of the server in the settings where none is given."""
    settings = read_settings(os.environ)
    return Client(server or f"http://{settings.server.host}:{settings.server.port}", settings.client.token)
