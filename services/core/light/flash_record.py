"""The acknowledgements of faster flashes under which a job has lit its dome: ``flashes.json`` in the job's folder.

The file is written before the first light of an attempt, so that no later attempt flashes under an acknowledgement that
was given for another one.
"""

from __future__ import annotations

from pathlib import Path

from services.core.geometry import Record
from services.core.light.safety import FlashAcknowledgement
from services.core.store import read_record, write_record

FILE = "flashes.json"


class UsedAcknowledgements(Record):
    """Content of the file."""

    used: tuple[FlashAcknowledgement, ...] = ()


def used_in(root: Path) -> tuple[FlashAcknowledgement, ...]:
    """Return the acknowledgements under which the job in this folder has flashed, in the order of their use."""
    path = root / FILE
    return read_record(path, UsedAcknowledgements).used if path.exists() else ()


def record_use(root: Path, acknowledged: FlashAcknowledgement) -> None:
    """Store durably that the job in this folder flashes under an acknowledgement from now on."""
    write_record(root / FILE, UsedAcknowledgements(used=(*used_in(root), acknowledged)))
