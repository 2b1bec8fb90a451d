"""Whether an asset can be made again: the job that made it, and where a second run differs from the first."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from services.core.errors import CaptureInputError, CorruptStoreError, MissingStageError, SettingsError
from services.core.files.validation import fault_of, first_error
from services.core.provenance.hash_list import require_unedited
from services.core.provenance.inputs import hashed_inputs
from services.core.provenance.record import PROVENANCE, Provenance
from services.core.records import JOB_FILE, JobSpec
from services.core.store import read_record
from services.transport.provenance import machine, versions

NUMBERS = ("parameters.json", "errors.json")
"""Files of an asset whose values are compared one by one."""
SURFACES = ("*.ply", "teeth/**/*")
"""Files of an asset that are compared byte by byte: surfaces, and textures of stains."""


@dataclass(frozen=True)
class Asset:
    """An exported asset, and the folder of the job that made it."""

    folder: Path
    job: Path
    """The folder above; it holds the job's options where the asset was not copied elsewhere."""
    provenance: Provenance


def open_asset(place: Path) -> Asset:
    """Open the asset of a job by the job's folder or its own.

    Raises:
        MissingStageError: there is no asset that says where it comes from. CorruptStoreError: it was edited by hand.
    """
    folder = place / "asset" if (place / "asset").is_dir() else place
    if not (folder / PROVENANCE).is_file():
        raise MissingStageError(
            f"{folder} holds no {PROVENANCE}, as assets of earlier versions, so what it was made from is unknown;"
            " write it again with dentine export."
        )
    require_unedited(folder)
    try:
        return Asset(folder, folder.parent, read_record(folder / PROVENANCE, Provenance))
    except CaptureInputError as problem:
        raise CorruptStoreError(
            f"{folder / PROVENANCE} cannot be read by this version; write the asset again with dentine export."
        ) from problem


def job_again(asset: Asset, capture: Path | None, calibration: Path | None) -> JobSpec:
    """The job that makes an asset again. That of a rig begins with the photographs that were taken.

    Args:
        capture: the capture, where it is not found by the options of the job's folder; None to take that.
        calibration: the calibration, likewise.

    Raises:
        SettingsError: a file is not found, or this version does not have an option of the asset's job.
    """
    options = dict(asset.provenance.options)
    stored = read_record(asset.job / JOB_FILE, JobSpec) if (asset.job / JOB_FILE).is_file() else None
    is_of_rig = options.pop("rig", None) is not None
    if capture is None and stored is not None:
        capture = asset.job / "capture" if is_of_rig else stored.capture
    if capture is None or not capture.exists():
        where = "" if capture is None else f"; {capture} is not there"
        raise SettingsError(
            f"The capture {asset.provenance.source} of {asset.folder} is not found{where}; name its folder by"
            " --capture."
        )
    options["capture"] = capture
    if options.get("calibration") is not None:
        found = calibration or (None if stored is None else stored.calibration)
        if found is None or not found.is_file():
            raise SettingsError(
                f"The calibration {options['calibration']} of {asset.folder} is not found; name its file by"
                " --calibration."
            )
        options["calibration"] = found
    try:
        return JobSpec.model_validate(options)
    except ValidationError as problem:
        raise SettingsError(
            f"The options of {asset.folder} are not those of this version: {fault_of(first_error(problem), JobSpec)}."
        ) from problem


def changed_inputs(asset: Asset, spec: JobSpec, job: Path) -> list[str]:
    """In which files the inputs differ from those that the asset was made from, as sentences; empty if in none."""
    recorded = asset.provenance.inputs
    if recorded is None:
        return []
    present = {one.name: one for one in hashed_inputs(spec, job)}
    found = [
        f"Input {one.name} is absent." if one.name not in present else f"Input {one.name} is another file."
        for one in recorded
        if one.name not in present or present[one.name].sha256 != one.sha256
    ]
    are_photographs_told = asset.provenance.photographs_left_out is None
    known = {one.name for one in recorded}
    return found + [
        f"Input {name} was not there."
        for name, one in present.items()
        if name not in known and (are_photographs_told or not one.is_photograph)
    ]


def changed_machine(asset: Asset) -> list[str]:
    """Which versions and which processor differ from those of the asset, as sentences."""
    before = asset.provenance.versions | {"processor": asset.provenance.platform}
    now = versions() | {"processor": machine()}
    return [
        f"Version of {name}: {before.get(name, 'none')} then, {now.get(name, 'none')} now."
        for name in dict.fromkeys([*before, *now])
        if before.get(name) != now.get(name)
    ]


def changed_results(before: Path, after: Path) -> tuple[int, list[str]]:
    """Number of values and surfaces that were compared, and where two assets differ, as sentences.

    Args:
        before: folder of the first asset.
        after: folder of the second.
    """
    count, found = 0, []
    for name in NUMBERS:
        one, two = (dict(_leaves(json.loads((folder / name).read_text()))) for folder in (before, after))
        count += len(one.keys() | two.keys())
        for key in dict.fromkeys([*one, *two]):
            if one.get(key) != two.get(key):
                values = f"{one.get(key, 'absent')} then, {two.get(key, 'absent')} now"
                found.append(f"{name} {key}: {values}{_in_se(one, two, key)}.")
    names = {
        path.relative_to(folder).as_posix()
        for folder in (before, after)
        for pattern in SURFACES
        for path in folder.glob(pattern)
        if path.is_file()
    }
    for name in sorted(names):
        count += 1
        contents = [path.read_bytes() if (path := folder / name).is_file() else None for folder in (before, after)]
        if contents[0] != contents[1]:
            found.append(f"{name} is another surface or texture.")
    return count, found


def _in_se(one: Mapping[str, Any], two: Mapping[str, Any], key: str) -> str:
    # An estimate's difference is told in its standard errors too.
    place, _, leaf = key.rpartition(" ")
    se = one.get(f"{place} se")
    if leaf != "value" or not isinstance(se, float) or not se > 0 or not isinstance(two.get(key), float):
        return ""
    return f" ({abs(one[key] - two[key]) / se:.2g} standard errors)" if math.isfinite(one[key]) else ""


def _leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, own in value.items():
            yield from _leaves(own, f"{place} {key}".strip())
    elif isinstance(value, list):
        for number, own in enumerate(value):
            yield from _leaves(own, f"{place} {number}".strip())
    else:
        yield place, value
