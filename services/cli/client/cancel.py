"""``dentine cancel``: stop a job."""

from __future__ import annotations

from services.cli.arguments import JobId, Server
from services.cli.client.connection import connect


def cancel(job_id: JobId, server: Server = None) -> None:
    """Cancel a job; the lights go off first and what is published is kept."""
    with connect(server) as client:
        print(client.cancel(job_id)["state"])
