"""The stored result of a finished wavelength: its fit, its images, and the fingerprint of its data and options, in the
wavelength's journal.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import read_folder
from services.core.store import write_atomic
from services.slab.dictionaries.table import table_file
from services.slab.options import SlabOptions
from services.slab.results.result import SlabFit, Wavelength
from services.slab.solve.checkpoint import STEP
from services.tasks.journal import Journal, read_arrays, read_entries
from services.transport.numerics import numerics_name

JOURNAL = "journal.jsonl"
"""Name of the journal in a wavelength's folder."""
FIT = "fit"
"""Key of the result in the journal."""
LATER_OPTIONS = ("dictionary", "particle_index", "particle_absorption")
"""Options that version 0.1.0 did not have."""


@dataclass(frozen=True)
class Images:
    """A wavelength's images (images, rows, columns), measured and predicted."""

    measured: NDArray[np.float64]
    """NaN where a pixel was left out."""
    predicted: NDArray[np.float64]
    held_out: NDArray[np.bool_]
    names: tuple[str, ...]


def fingerprint(root: Path, wavelength_nm: float, options: SlabOptions) -> str:
    """A digest that identifies all that a wavelength's result depends on."""
    folder, digest = read_folder(root), hashlib.sha256()
    # Leave out options at these defaults, so that results stored by earlier versions are still used.
    at_default = {name for name in LATER_OPTIONS if getattr(options, name) == SlabOptions.model_fields[name].default}
    options_json = options.model_dump_json(exclude=at_default)
    # Leave out exposures too where there are none, and what is of exposures alone.
    of_exposures: dict[str, Any] = {"exposures": True, "cameras": {"__all__": {"counts"}}}
    described = folder.model_dump_json(exclude=None if folder.exposures else of_exposures)
    for part in (numerics_name(), described, options_json, f"{wavelength_nm:g}"):
        digest.update(part.encode() + b"\n")
    if options.dictionary == "table":
        digest.update(hashlib.sha256(table_file(root).read_bytes()).digest())
    for image in folder.images_at(wavelength_nm) if folder.images else ():
        for file in (image.file, image.variance_file):
            digest.update(b"none" if file is None else hashlib.sha256((root / file).read_bytes()).digest())
    for exposure in folder.exposures_at(wavelength_nm):
        digest.update(hashlib.sha256((root / exposure.file).read_bytes()).digest())
    return digest.hexdigest()


def open_journal(place: Path, digest: str, guard: Callable[[], None]) -> Journal:
    """Journal of a wavelength, in its folder; see ``Journal``."""
    return Journal(place / JOURNAL, digest, guard)


def store_result(journal: Journal, wavelength: Wavelength) -> None:
    """Record a wavelength's result, after which the state of its fit is not needed any more."""
    journal.put(
        FIT,
        json.loads(wavelength.fit.model_dump_json()),
        measured=wavelength.measured,
        predicted=wavelength.predicted,
        held_out=wavelength.held_out,
        names=np.array(wavelength.names),
    )
    journal.forget(STEP)


def read_result(place: Path) -> SlabFit | None:
    """The result in a wavelength's folder; None where it has none."""
    value = read_entries(place / JOURNAL).get(FIT)
    return None if value is None else SlabFit.model_validate_json(json.dumps(value))


def copy_result_images(place: Path, path: Path) -> None:
    """Write the images of the result in a wavelength's folder into a file of their own."""
    arrays: dict[str, Any] = read_arrays(place / JOURNAL, FIT)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    write_atomic(path, stream.getvalue())


def read_result_images(path: Path) -> Images:
    """Images as ``copy_result_images`` wrote them."""
    with np.load(path, allow_pickle=False) as arrays:
        return Images(
            arrays["measured"], arrays["predicted"], arrays["held_out"], tuple(str(name) for name in arrays["names"])
        )
