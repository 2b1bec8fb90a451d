"""``dentine retry``: queue a job again."""

from __future__ import annotations

from services.cli.arguments import JobId, Server
from services.cli.client.connection import connect


def retry(job_id: JobId, server: Server = None) -> None:
    """Queue a failed or cancelled job again; it resumes from what it had published."""
    with connect(server) as client:
        print(client.retry(job_id)["state"])
