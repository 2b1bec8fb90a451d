"""``dentine delete``: remove a job with its files."""

from __future__ import annotations

import json

from services.cli.arguments import JobId, Json, Server
from services.cli.client.connection import connect


def delete(job_id: JobId, server: Server = None, as_json: Json = False) -> None:
    """Delete a job that has ended, with all its files; prints the receipt."""
    with connect(server) as client:
        receipt = client.delete(job_id)
    print(
        json.dumps(receipt)
        if as_json
        else f"deleted: {job_id}, {receipt['files']} files of {receipt['bytes']} bytes, digest {receipt['digest']}"
    )
