"""The files that a preparation reads, with their hashes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from services.core.calibration.record import published_capture, read_description
from services.core.masks import FOLDER as MASKS
from services.core.provenance.record import INPUTS, InputFile, Inputs
from services.core.raw.folder import DESCRIPTION, is_raw_folder, parse_raw_folder, read_raw_folder
from services.core.raw.records import RawFolder
from services.core.raw.registration import REGISTRATION
from services.core.records import FolderCapture, JobSpec
from services.core.store import MANIFEST, read_record, sha256_of

NO_IMAGES = frozenset({".json", ".csv", ".txt"})
"""Endings of a slab's files that hold no image."""


@dataclass(frozen=True)
class InputPath:
    """A file by the name under which it is listed."""

    name: str
    path: Path
    is_photograph: bool


def paths_of_inputs(spec: JobSpec, root: Path) -> tuple[InputPath, ...]:
    """The files from which a job's preparation is made, or all files of a slab's folder, photographs first.

    Args:
        root: folder of the job, which holds masks by hand and the capture of a rig.

    Raises:
        CaptureInputError: the description of the capture cannot be read.
    """
    found = [*_of_capture(spec, root)]
    found += [InputPath(f"{MASKS}/{path.name}", path, True) for path in sorted((root / MASKS).glob("[!.]*"))]
    if spec.calibration is not None:
        found.append(InputPath(f"calibration/{spec.calibration.name}", spec.calibration, False))
    return tuple(sorted(found, key=lambda one: not one.is_photograph))


def hashed_inputs(spec: JobSpec, root: Path, between: Callable[[], None] = lambda: None) -> tuple[InputFile, ...]:
    """The same files with size and SHA-256.

    Args:
        between: called before each file; an error that it raises ends the reading.
    """
    found = []
    for one in paths_of_inputs(spec, root):
        between()
        size, sha256 = one.path.stat().st_size, sha256_of(one.path)
        found.append(InputFile(name=one.name, bytes=size, sha256=sha256, is_photograph=one.is_photograph))
    return tuple(found)


def recorded_inputs(prepared: Path) -> Inputs | None:
    """What a published preparation has recorded; None where an earlier version made it."""
    return read_record(prepared / INPUTS, Inputs) if (prepared / INPUTS).is_file() else None


def stated_by(capture: Path | None) -> RawFolder | FolderCapture | None:
    """What a capture says at present of the person's label and consent; None where its description is gone.

    Raises:
        CaptureInputError: the description cannot be read.
    """
    if capture is None:
        return None
    if is_raw_folder(capture):
        return parse_raw_folder((capture / DESCRIPTION).read_bytes(), str(capture / DESCRIPTION))
    is_there = any((capture / name).is_file() for name in ("capture.json", MANIFEST, f"capture/{MANIFEST}"))
    return read_description(capture) if is_there else None


def _of_capture(spec: JobSpec, root: Path) -> Iterator[InputPath]:
    if spec.kind == "slab" and spec.capture is not None:
        for path in sorted(path for path in spec.capture.rglob("*") if path.is_file()):
            yield InputPath(path.relative_to(spec.capture).as_posix(), path, path.suffix.lower() not in NO_IMAGES)
        return
    published = (root, "capture") if spec.capture is None else published_capture(spec.capture)
    if published is not None:
        folder = published[0] / published[1]
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            name = path.relative_to(folder).as_posix()
            # The manifest lists hashes of the photographs.
            yield InputPath(name, path, ".zarr/" in name or name == MANIFEST)
        return
    assert spec.capture is not None
    capture = spec.capture
    photographs: list[str] = []
    others: list[str] = []
    if is_raw_folder(capture):
        described = read_raw_folder(capture)
        photographs += [frame.file for frame in described.frame]
        others += [DESCRIPTION, *(chart.reference for chart in described.chart)]
        others += [described.scan.file] if described.scan is not None else []
        if described.calibration is not None:
            yield InputPath(
                f"calibration/{Path(described.calibration.file).name}", capture / described.calibration.file, False
            )
    else:
        entries = read_description(capture).images
        photographs += [file for entry in entries for file in (entry.file, entry.variance_file) if file is not None]
        others.append("capture.json")
    surfaces = [path.relative_to(capture).as_posix() for path in sorted(capture.rglob("*.ply"))] + [REGISTRATION]
    for names, is_photograph in ((photographs, True), (dict.fromkeys([*others, *surfaces]), False)):
        for name in names:
            if (capture / name).is_file():
                yield InputPath(name, capture / name, is_photograph)
