"""Read ``raw.toml``, and name in one sentence what is wrong with it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from services.core.consent import Consent
from services.core.errors import CaptureInputError
from services.core.files.validation import fault_text
from services.core.geometry import Record
from services.core.raw.records import RawCamera, RawFolder, RawFrame, RawLight
from services.core.raw.targets import Board, CalibrationFile, Chart, Landmark, ScanFile, SeenPoint, Sphere

DESCRIPTION = "raw.toml"
MAX_DESCRIPTION_BYTES = 16 * 2**20
"""Largest size of ``raw.toml``, bytes; a hundred thousand frames take less."""
_KINDS: Mapping[str, type[Record]] = MappingProxyType(
    {
        "calibration": CalibrationFile,
        "camera": RawCamera,
        "light": RawLight,
        "frame": RawFrame,
        "board": Board,
        "sphere": Sphere,
        "chart": Chart,
        "consent": Consent,
        "scan": ScanFile,
        "landmark": Landmark,
        "pixels": SeenPoint,
    }
)
"""Key in ``raw.toml`` -> record of the entries below it."""


def is_raw_folder(root: Path) -> bool:
    """Whether a folder is described by ``raw.toml``; one with ``capture.json`` too is a capture of linear images."""
    return (root / DESCRIPTION).is_file() and not (root / "capture.json").is_file()


def read_raw_folder(root: Path) -> RawFolder:
    """Read ``root/raw.toml`` and check that the files it names lie in the folder and exist.

    Raises:
        CaptureInputError: an entry is wrong; the message names it, and the file, key or name in it.
    """
    origin = root / DESCRIPTION
    if not origin.is_file():
        raise CaptureInputError(f"{origin} does not exist; 'dentine import {root}' makes one from named files.")
    folder = parse_raw_folder(origin.read_bytes(), str(origin))
    require_files(root, folder)
    return folder


def scan_of(root: Path, folder: RawFolder) -> ScanFile:
    """The scan that a raw folder names.

    Raises:
        CaptureInputError: it names none.
    """
    if folder.scan is None:
        raise CaptureInputError(f"{root / DESCRIPTION} names no scan; add [scan] with its file, units and jaw.")
    return folder.scan


def parse_raw_folder(content: bytes, origin: str) -> RawFolder:
    """Parse the content of ``raw.toml``; whether the files it names exist is not checked.

    Args:
        origin: name of the file in messages.

    Raises:
        CaptureInputError: the content is no TOML, or has an unknown key, a wrong value or a name that is not listed.
    """
    if len(content) > MAX_DESCRIPTION_BYTES:
        raise CaptureInputError(
            f"{origin} has {len(content)} bytes and {MAX_DESCRIPTION_BYTES} are read; split the capture."
        )
    try:
        tree = tomllib.loads(content.decode())
    except RecursionError as problem:
        raise CaptureInputError(f"{origin} nests brackets too deeply; it needs three levels at most.") from problem
    except ValueError as problem:  # also raised by bytes that are no UTF-8
        raise CaptureInputError(f"{origin} is not valid TOML: {problem}; correct that line.") from problem
    try:
        return RawFolder.model_validate(tree)
    except ValidationError as problem:
        raise CaptureInputError(f"{origin}: {_error_text(problem, tree)}.") from problem


def require_files(root: Path, folder: RawFolder) -> None:
    """Check that each file that a description names lies in its folder and exists; a calibration may lie outside.

    Raises:
        CaptureInputError: a file does not; the message names the first such file and its meaning.
    """
    for frame in folder.frame:
        require_inside(root, frame.file, f"Frame {frame.file} ({frame.label})")
    for chart in folder.chart:
        require_inside(root, chart.reference, f"Reference {chart.reference} of chart {chart.name}")
    if folder.scan is not None:
        require_inside(root, folder.scan.file, f"Scan {folder.scan.file}")
    if folder.calibration is not None and not (root / folder.calibration.file).is_file():
        raise CaptureInputError(
            f"Calibration {root / folder.calibration.file} does not exist; correct [calibration] file, or leave it out "
            "and name a calibration in the job."
        )


def require_inside(root: Path, file: str, what: str) -> Path:
    """Return the absolute path of a file of a raw folder.

    Args:
        root: the raw folder.
        file: path relative to the folder.
        what: the file and its meaning, in words with which an error message begins.

    Raises:
        CaptureInputError: the path leads out of the folder, or is no file.
    """
    try:
        path = (root / file).resolve()
        is_inside, is_file = path.is_relative_to(root.resolve()), path.is_file()
    except (OSError, ValueError, RuntimeError) as problem:
        raise CaptureInputError(f"{what} cannot be looked up ({problem}); correct its path.") from problem
    if not is_inside:
        raise CaptureInputError(f"{what} lies outside the folder {root}; put it inside.")
    if not is_file:
        raise CaptureInputError(f"{what} does not exist in {root}; put it there or remove its entry.")
    return path


def _error_text(problem: ValidationError, tree: Mapping[str, Any]) -> str:
    first = problem.errors()[0]
    entry, kind = _entry_at(first["loc"], tree)
    key = str(first["loc"][-1]) if first["loc"] else ""
    return fault_text(first, kind, key, place=entry, value=_key(first["loc"]))


def _entry_at(location: Sequence[int | str], tree: Mapping[str, Any]) -> tuple[str, type[Record]]:
    """The entry in which a validation error lies, in words, and the record whose keys are known there."""
    parts: list[str] = []
    kind: type[Record] = RawFolder
    node: Any = tree
    for depth, step in enumerate(location):
        node = _child(node, step)
        if isinstance(step, str) and step in _KINDS and (depth + 1 < len(location) or isinstance(node, Mapping)):
            kind = _KINDS[step]
            parts.append(step)
        if isinstance(step, int) and isinstance(node, Mapping):
            parts.append(f"{step + 1}{_name(node)}")
    return " ".join(parts) + (": " if parts else ""), kind


def _child(node: Any, step: int | str) -> Any:
    try:
        return node[step]
    except (KeyError, IndexError, TypeError):
        return None


def _name(entry: Mapping[str, Any]) -> str:
    name = entry.get("name", entry.get("file", entry.get("tooth")))
    return "" if name is None else f" ({name})"


def _key(location: Sequence[int | str]) -> str:
    """The key of a wrong value, with its place in a list of numbers; empty for a record as a whole."""
    numbers = [step for step in location if isinstance(step, int)]
    keys = [step for step in location if isinstance(step, str)]
    if not keys or keys[-1] in _KINDS:
        return ""
    depth = len(location) - 1 - max(k for k, step in enumerate(location) if step == keys[-1])
    return f"{keys[-1]}{''.join(f'[{n}]' for n in numbers[len(numbers) - depth :])}: " if depth else f"{keys[-1]}: "
