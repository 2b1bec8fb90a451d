"""``dentine jobs``: list the jobs of a server."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.arguments import Json, Server
from services.cli.client.connection import connect
from services.cli.client.watch import shown_state

if TYPE_CHECKING:
    from services.client.client import Client

MAX_AT_ONCE = 500
"""Largest number of jobs that a server lists in one answer."""


def jobs(
    server: Server = None,
    state: Annotated[
        list[str] | None, typer.Option(help="Only jobs in this state, such as failed; may be given several times.")
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="Only jobs of this kind: tooth, jaw, object, slab or calibration.")
    ] = None,
    capture: Annotated[
        str | None, typer.Option(help="Only jobs with this text in the path of their capture or rig's mouth.")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Most jobs to list.")] = 50,
    as_json: Json = False,
) -> None:
    """List the jobs of a server, newest first."""
    only = {"state": [one.upper() for one in state or ()] or None, "kind": kind, "capture": capture}
    with connect(server) as client:
        found = _list(client, limit, only)
    nothing = "There is no such job." if any(only.values()) else "The server has no jobs yet."
    print(json.dumps(found) if as_json else "\n".join(map(_line, found)) or nothing)


def _list(client: Client, limit: int, only: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    before = None
    while len(found) < limit:
        page = client.jobs(min(limit - len(found), MAX_AT_ONCE), before, **only)
        found += page["jobs"]
        if (before := page["next_before"]) is None:
            break
    return found


def _line(job: dict[str, Any]) -> str:
    submitted = datetime.fromtimestamp(job["created_s"], UTC).strftime("%Y-%m-%d %H:%M UTC")
    source = job["spec"]["rig"]["mouth"] if job["spec"]["rig"] else job["spec"]["capture"]
    return f"{job['id']}  {shown_state(job):<13}  {submitted}  {job['name'] or '-'}  {source}"
