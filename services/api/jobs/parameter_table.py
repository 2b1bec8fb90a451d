"""The parameters that a job has estimated, as a CSV table for spreadsheets."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from services.client.errors import JobStateError
from services.core.results import Estimate

COLUMNS = ("job", "channel", "parameter", "value", "se", "unit", "determined")
"""Columns of the table. ``se`` is one standard error, empty where nothing was fitted. The column with the job allows to
append the tables of several jobs to each other."""
_FORMULA_MARKS = ("=", "+", "-", "@", "'")
"""First characters at which a spreadsheet takes a cell for a formula. The name of a channel comes with the capture, so
it is marked as text and not computed."""
_TABLES: TypeAdapter[dict[str, dict[str, Estimate]]] = TypeAdapter(dict[str, dict[str, Estimate]])


def parameter_table(job_id: str, path: Path) -> str:
    """Return the parameters of a job as CSV (RFC 4180), one row per channel and parameter, with numbers as exact as
    they are stored.

    Args:
        path: the job's ``parameters.json``.

    Raises:
        JobStateError: the file holds no parameters.
    """
    try:
        tables = _TABLES.validate_json(path.read_bytes())
    except ValidationError as problem:
        raise JobStateError(
            f"The parameters of job {job_id} cannot be read as a table; look at its artifact {path.name}."
        ) from problem
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    for channel, table in tables.items():
        for name, estimate in table.items():
            se = "" if estimate.se is None else estimate.se
            determined = "true" if estimate.determined else "false"
            writer.writerow((job_id, _shown(channel), _shown(name), estimate.value, se, estimate.unit, determined))
    return text.getvalue()


def _shown(text: str) -> str:
    return f"'{text}" if text.startswith(_FORMULA_MARKS) else text
