"""Checks exported folders: whether they are as they were written, and whether each program of others takes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from services.assets.verification.clients import (
    Client,
    check_blender,
    check_gltf,
    check_materialx,
    check_mitsuba,
    check_usd,
)
from services.core.errors import MissingStageError
from services.core.provenance.hash_list import require_unedited
from services.core.store import MANIFEST

State = Literal["passed", "failed", "not installed"]
Check = Callable[[Path, str], Client | None]
CHECKS: tuple[tuple[str, str, Check], ...] = (
    ("scene*.xml", "Mitsuba", check_mitsuba),
    ("blender/blender_scene.py", "Blender", check_blender),
    ("*.gl[tb]*", "glTF validator", check_gltf),
    ("*.usd*", "USD validators", check_usd),
    ("*.mtlx", "MaterialX", check_materialx),
)
"""Pattern of files -> program that checks each of them. A check is given the file and an interpreter that may have the
program's module besides this one, or an empty text; it returns None where the program is not installed."""


@dataclass(frozen=True)
class Checked:
    """What one check of one folder has found."""

    folder: Path
    what: str
    """Program and version, or ``files``."""
    state: State
    findings: tuple[str, ...] = ()
    """Sentences; of a check that passed, what to know besides."""


def exported_folders(place: Path) -> tuple[Path, ...]:
    """The folders to check: the folder itself where it is an exported one, or those of a job.

    Raises:
        MissingStageError: there is none.
    """
    if (place / MANIFEST).is_file():
        return (place,)
    found = tuple(sorted(path for path in place.glob("asset*") if (path / MANIFEST).is_file()))
    if not found:
        raise MissingStageError(f"{place} holds no exported asset with a {MANIFEST}; write one with dentine export.")
    return found


def verify(folder: Path, interpreter: str = "") -> tuple[Checked, ...]:
    """Check one exported folder.

    Args:
        interpreter: Python with modules of others, such as ``bpy``; empty to look in this one alone.

    Raises:
        CorruptStoreError: a file was edited or removed.
    """
    added = require_unedited(folder)
    notes = tuple(f"{name} was added since the asset was written." for name in added)
    found = [Checked(folder, "files as written", "passed", notes)]
    for pattern, name, check in CHECKS:
        for file in sorted(folder.glob(pattern)):
            client = check(file, interpreter)
            what = f"{name if client is None else client.name}, {file.relative_to(folder).as_posix()}"
            if client is None:
                found.append(Checked(folder, what, "not installed"))
            else:
                found.append(Checked(folder, what, "failed" if client.findings else "passed", client.findings))
    return tuple(found)
