"""What of a job's data has left the server, by the audit log, and whether more may leave."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated

import sqlalchemy as sql
from pydantic import Field

from services.api.auth.audit import audit_table
from services.core.consent import Consent, require_allowed
from services.core.errors import CaptureInputError, ConsentError, CorruptStoreError
from services.core.files.json_text import parse_json
from services.core.geometry import Record
from services.core.provenance.record import PROVENANCE

if TYPE_CHECKING:
    from fastapi import Request

EXPORTED = ("asset", "report.html", "parameters.json", "errors.json")
"""Beginnings of the paths of a job's files that are results to hand out; the others are its working files."""
SENT = (200, 206)
"""HTTP status of an answer that carried a file or a part of one."""
Use = Annotated[
    str | None, Field(max_length=64, description="what the files are for, as the person's consent names it")
]


class Departure(Record):
    """Files of a job that one caller has read."""

    what: str = Field(
        description="first part of the files' path, such as asset or report.html, or the route's own name"
    )
    who: str = Field(description="name of the token, or 'local' without one")
    uses: tuple[str, ...] = Field(description="what the caller said that they are for; empty where nothing was said")
    times: int = Field(description="number of answers that carried a file, or a part of one")
    first_s: float = Field(description="Unix time")
    last_s: float = Field(description="Unix time")


def require_departure(job: Path, path: str, use: str | None) -> None:
    """Refuse to hand out a result that the person has not agreed to, by the consent that the asset recorded.

    Args:
        job: the job's folder.
        path: what is asked for, relative to it; empty for all files.
        use: what it is for; None where that is not said.

    Raises:
        ConsentError: the consent has ended, or does not list the use. CorruptStoreError: what was recorded of it cannot
            be read.
    """
    # Of two spellings of one path, such as report.html and ./report.html, both are the result.
    if path and not str(PurePosixPath(path)).startswith(EXPORTED):
        return
    file = job / "asset" / PROVENANCE
    if not file.is_file():
        return
    try:
        recorded = parse_json(file.read_bytes())["consent"]
        consent = None if recorded is None else Consent.model_validate(recorded)
    except (ValueError, KeyError, TypeError, RecursionError, CaptureInputError) as problem:
        raise CorruptStoreError(
            "The provenance of the asset cannot be read, so nothing says what the person agreed to; restore it, or run"
            " the job anew."
        ) from problem
    try:
        require_allowed(consent, use, datetime.now(UTC))
    except ConsentError as refused:
        what = refused.message.removesuffix(".")
        raise ConsentError(f"{what}; a job takes up a changed consent when it is run anew.") from refused


def said_use(request: Request, use: str | None) -> str | None:
    """What a caller says that files are for, once it is in the row that the audit log will have."""
    if use is not None:
        request.scope["audited"].ids["use"] = use
    return use


def departures(engine: sql.Engine, job_id: str) -> tuple[Departure, ...]:
    """What has left of a job, in the order in which it left first."""
    query = (
        sql.select(audit_table)
        .where(
            audit_table.c.action.startswith("GET "),
            audit_table.c.outcome.in_(SENT),
            audit_table.c.ids.contains(json.dumps({"job_id": job_id})[1:-1], autoescape=True),
        )
        .order_by(audit_table.c.id)
    )
    with engine.connect() as connection:
        return _grouped(connection.execute(query).mappings())


def _grouped(rows: Iterable[sql.RowMapping]) -> tuple[Departure, ...]:
    found: dict[tuple[str, str], Departure] = {}
    for row in rows:
        ids = json.loads(row["ids"])
        what, who, time_s = _what(row["action"], ids), row["who"], row["time_s"]
        uses = (ids["use"],) if "use" in ids else ()
        one = found.get((what, who)) or Departure(what=what, who=who, uses=(), times=0, first_s=time_s, last_s=time_s)
        found[what, who] = one.model_copy(
            update={"uses": tuple(dict.fromkeys((*one.uses, *uses))), "times": one.times + 1, "last_s": time_s}
        )
    return tuple(found.values())


def _what(action: str, ids: dict[str, str]) -> str:
    # A route without a path of its own is told by what follows the job in it, such as artifacts.zip or previews.
    if path := PurePosixPath(ids.get("path", "")).parts:
        return path[0]
    return action.partition("{job_id}/")[2].partition("/")[0]
