"""Records of finished work by many writers: one file a record.

``Journal`` and ``RecordFiles`` both let a new attempt go on where an earlier one stopped. A journal has one writer, the
driver, whose results follow each other; each is a line of one file. Where workers finish parts that do not depend on
each other, and read each other's records, each part has a file of its own: a worker writes it as soon as its part is
done, so even if the driver is killed, no part is lost but those that were being made.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from services.core.geometry import Record
from services.core.store import write_atomic

R = TypeVar("R", bound=Record)
PLAN = "plan.json"
"""Name of the file that says of which inputs the records are; it is written first and removed first."""


class _Plan(Record):
    digest: str


class RecordFiles:
    """Records by name in a folder; the object is sent to the workers.

    Args:
        folder: folder of the records; ``a/b`` is the name of the record in ``a/b.json``.
        guard: called before every write; raises when this attempt has lost the right to write.
    """

    def __init__(self, folder: Path, guard: Callable[[], None]) -> None:
        self.folder, self._guard = folder, guard

    def are_of(self, fingerprint: str) -> bool:
        """Whether the records are of the inputs with this fingerprint."""
        plan = _read(self.folder / PLAN, _Plan)
        return plan is not None and plan.digest == fingerprint

    def mark(self, fingerprint: str) -> None:
        """Declare the records to be of the inputs with this fingerprint, from when on they can be continued."""
        self._write(self.folder / PLAN, _Plan(digest=fingerprint))

    def remove(self) -> None:
        """Remove the folder with all records."""
        # Remove the plan first, because it declares the other files as those of its inputs
        (self.folder / PLAN).unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)

    def put(self, name: str, record: Record) -> None:
        """Write a record, in place of an earlier one of this name."""
        self._write(self.folder / f"{name}.json", record)

    def get(self, name: str, kind: type[R]) -> R | None:
        """The record of this name; None if there is none."""
        return _read(self.folder / f"{name}.json", kind)

    def set_damaged_aside(self, kinds: Mapping[str, type[Record]]) -> list[str]:
        """Rename files that cannot be read as records, so that their parts are made again; returns a note on each.

        Args:
            kinds: first word of a record's name (before the first hyphen) -> its kind.
        """
        notes = []
        for path in sorted(self.folder.glob("*/*.json")):
            kind = kinds.get(path.stem.partition("-")[0])
            if kind is not None and _read(path, kind) is None:
                self._guard()
                path.rename(aside := _free_name(path))
                where = path.relative_to(self.folder)
                notes.append(f"The record {where} is damaged: it is kept as {aside.name}, and its part is made again.")
        return notes

    def _write(self, path: Path, record: Record) -> None:
        self._guard()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, record.model_dump_json().encode())


def _read(path: Path, kind: type[R]) -> R | None:
    try:
        return kind.model_validate_json(path.read_bytes())
    except (FileNotFoundError, ValidationError):
        return None


def _free_name(path: Path) -> Path:
    numbers = (path.with_name(f"{path.name}-set-aside-{k}") for k in itertools.count(1))
    return next(candidate for candidate in numbers if not candidate.exists())
