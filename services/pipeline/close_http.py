"""What every scheduler and worker loads (``--preload services.pipeline.close_http``): closes the HTTP port that Dask
opens beside its own.

Dask has no option against it. The port asks nobody who he is, and what it tells this program's API tells better.
"""

from __future__ import annotations

from typing import Any


def dask_setup(node: Any) -> None:
    """Called by Dask in the process of each scheduler and worker; stops listening."""
    node.http_server.stop()
