"""``dentine serve``: the API and the page."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer


def serve(
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port to listen on; 0 picks a free one; default: the settings'."),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the database and the jobs; default: the settings'.")
    ] = None,
) -> None:
    """Serve the API and the dashboard on loopback."""
    from services.api.server import serve as serve_api
    from services.core.settings import read_settings

    server = read_settings(os.environ).server
    changes = {name: value for name, value in (("port", port), ("data", data)) if value is not None}
    serve_api(server.model_copy(update=changes))
