"""Calibrations by name. The content of a name never changes; jobs refer to the content.

::

    calibrations/<id>.json             the content; its id is the SHA-256 of these bytes
    calibrations/names/<name>.json     which content a name means in the default group
    calibrations/owners/<owner>/<name>.json    and to another owner, who has names of its own
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from services.client.errors import CalibrationTakenError, UnknownCalibrationError
from services.core.calibration.record import Calibration, require_consistent
from services.core.calibration.state import CalibrationState, broken_limits, refusal, state_of
from services.core.errors import SettingsError
from services.core.geometry import Record
from services.core.owners import DEFAULT_GROUP, LOCAL_VIEWER, Viewer
from services.core.records import JobSpec
from services.core.store import read_record, write_atomic, write_record

FOLDER = "calibrations"
"""Folder of calibrations below the data folder. A job names a calibration as ``calibrations/<id>``."""
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}"
_ID = re.compile(r"[0-9a-f]{64}")


class StoredName(Record):
    """The content that a name means, as it is stored."""

    name: str
    id: str = Field(description="SHA-256 of its content: the same for the same cameras, lights and channels")
    created_s: float = Field(description="Unix time")
    owner: str = Field(default=DEFAULT_GROUP, description="group that it belongs to, or token:ID of a token in none")
    made: str | None = Field(default=None, description="when it was calibrated, ISO 8601; null where it does not say")
    valid_days: float | None = Field(default=None, description="for how long it holds from then")
    broken: tuple[str, ...] | None = Field(
        default=None, description="limits that it does not keep, in words; null where it was held to none"
    )


class NamedCalibration(StoredName):
    """A calibration as it is listed."""

    state: CalibrationState = Field(
        description=(
            "good, old (beyond its valid_days), beyond its limits (jobs refuse it unless they accept_calibration), or"
            " not known"
        )
    )


class CalibrationDetail(NamedCalibration):
    """A calibration and what it says."""

    option: str = Field(description="give this as a job's option 'calibration'")
    calibration: Calibration


@dataclass(frozen=True)
class CalibrationCreation:
    """Result of putting a calibration: its details, and whether its name is new."""

    detail: CalibrationDetail
    is_new: bool


class Calibrations:
    """Use cases of the calibrations in one data folder.

    Args:
        now_s: returns Unix time in s.
    """

    def __init__(self, data: Path, now_s: Callable[[], float] = time.time) -> None:
        self._folder, self._now_s = data / FOLDER, now_s

    def put(self, name: str, calibration: Calibration, viewer: Viewer = LOCAL_VIEWER) -> CalibrationCreation:
        """Store a calibration under a name of the viewer's owner. Putting the same again changes nothing.

        Raises:
            CaptureInputError: names or channels of the calibration contradict each other. CalibrationTakenError: the
                name exists with another content.
        """
        require_consistent(calibration, f"Calibration {name}")
        content = (calibration.model_dump_json(indent=1) + "\n").encode()
        entry = StoredName(
            name=name,
            id=hashlib.sha256(content).hexdigest(),
            created_s=self._now_s(),
            owner=viewer.owner,
            made=calibration.made,
            valid_days=calibration.valid_days,
            broken=broken_limits(calibration),
        )
        names = self._names(viewer.owner)
        names.mkdir(parents=True, exist_ok=True)
        if not self._content(entry.id).exists():
            write_atomic(self._content(entry.id), content)
        is_new = self._take_name(entry)
        known = entry if is_new else read_record(names / f"{name}.json", StoredName)
        if known.id != entry.id:
            raise CalibrationTakenError(
                f"Calibration {name} exists with another content and is never changed; choose another name, such as one"
                " with a date."
            )
        return CalibrationCreation(self._detail(known, calibration), is_new)

    def list(self, viewer: Viewer = LOCAL_VIEWER) -> list[NamedCalibration]:
        """Return the calibrations that a viewer may see, newest first."""
        return [self._judged(entry) for entry in self._entries(viewer)]

    def get(self, name: str, viewer: Viewer = LOCAL_VIEWER) -> CalibrationDetail:
        """Return a calibration by its name; for a viewer who sees all, that of the viewer's own owner first.

        Raises:
            UnknownCalibrationError: there is none of this name that the viewer may see.
        """
        entry = self._named(name, viewer)
        return self._detail(entry, read_record(self._content(entry.id), Calibration))

    def by_content(self, spec: JobSpec, viewer: Viewer = LOCAL_VIEWER) -> JobSpec:
        """Return the job with the id of the content instead of the name in ``calibrations/<name>``, so that it means
        the same for ever; other jobs are returned as they are.

        Raises:
            SettingsError: there is none of this name that the viewer may see.
        """
        path = spec.calibration
        if path is None or not is_stored(path) or _ID.fullmatch(path.name):
            return spec
        try:
            return spec.model_copy(update={"calibration": Path(FOLDER, self._named(path.name, viewer).id)})
        except UnknownCalibrationError as problem:
            raise SettingsError(f"Option 'calibration': {problem.message}") from problem

    def require(self, path: Path, viewer: Viewer = LOCAL_VIEWER, *, accepted: bool = True) -> None:
        """Refuse the option of a job that names a calibration which does not exist, belongs to another owner, or is
        beyond its limits.

        Args:
            path: ``calibrations/<id>``.
            viewer: who submits the job.
            accepted: whether a calibration beyond its limits is accepted.

        Raises:
            SettingsError: there is none of this id that the viewer may see, or it is beyond its limits.
        """
        entries = [entry for entry in self._entries(viewer) if entry.id == path.name]
        is_id = _ID.fullmatch(path.name) is not None and self._content(path.name).is_file()
        if not is_id or not (viewer.sees_all or entries):
            raise SettingsError(
                f"Option 'calibration': there is no {path}; name one of GET /v1/calibrations as calibrations/NAME."
            )
        if not accepted and (bad := next((entry for entry in entries if entry.broken), None)):
            raise SettingsError(f"Option 'calibration': {refusal(bad.name, bad.broken or ())}")

    def locate(self, spec: JobSpec) -> JobSpec:
        """Return the job with the file of a stored calibration instead of its id."""
        if spec.calibration is None or not is_stored(spec.calibration):
            return spec
        return spec.model_copy(update={"calibration": self._content(spec.calibration.name)})

    def _entries(self, viewer: Viewer) -> tuple[StoredName, ...]:
        entries = [
            read_record(path, StoredName) for names in self._visible_folders(viewer) for path in names.glob("*.json")
        ]
        return tuple(sorted(entries, key=lambda entry: (-entry.created_s, entry.name, entry.owner)))

    def _named(self, name: str, viewer: Viewer) -> StoredName:
        paths = [names / f"{name}.json" for names in self._visible_folders(viewer)] if re.fullmatch(NAME, name) else []
        if (path := next((path for path in paths if path.is_file()), None)) is None:
            raise UnknownCalibrationError(f"There is no calibration {name}; list the calibrations to see their names.")
        return read_record(path, StoredName)

    def _judged(self, entry: StoredName) -> NamedCalibration:
        state = state_of(entry.made, entry.valid_days, entry.broken, self._now_s())
        return NamedCalibration(**entry.model_dump(), state=state)

    def _detail(self, entry: StoredName, calibration: Calibration) -> CalibrationDetail:
        listed = self._judged(entry).model_dump()
        return CalibrationDetail(**listed, option=f"{FOLDER}/{entry.id}", calibration=calibration)

    def _names(self, owner: str) -> Path:
        return self._folder / "names" if owner == DEFAULT_GROUP else self._folder / "owners" / owner

    def _visible_folders(self, viewer: Viewer) -> tuple[Path, ...]:
        # Return the folders of names that a viewer may see, that of the viewer's own owner first.
        own, others = (
            self._names(viewer.owner),
            [self._names(DEFAULT_GROUP), *sorted((self._folder / "owners").glob("*"))],
        )
        return (own, *(other for other in others if other != own)) if viewer.sees_all else (own,)

    def _content(self, calibration_id: str) -> Path:
        return self._folder / f"{calibration_id}.json"

    def _take_name(self, entry: StoredName) -> bool:
        # Creating a hard link is atomic, so that exactly one of several requests takes a name.
        written = self._folder / f".{secrets.token_hex(8)}"
        write_record(written, entry)
        try:
            os.link(written, self._names(entry.owner) / f"{entry.name}.json")
        except FileExistsError:
            return False
        finally:
            written.unlink()
        return True


def is_stored(path: Path) -> bool:
    """Whether a job names a calibration as a stored one, ``calibrations/<id>``."""
    return len(path.parts) == 2 and path.parts[0] == FOLDER
