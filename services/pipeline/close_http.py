"""Close the HTTP port that Dask opens beside its own: a preload module of every scheduler and worker (``--preload
services.pipeline.close_http``).

Dask has no option to leave the port closed. The port has no authentication, and this program's API gives the same
information better.
"""

from __future__ import annotations

from typing import Any


def dask_setup(node: Any) -> None:
    """Called by Dask in the process of each scheduler and worker; stops listening."""
    node.http_server.stop()
