"""The stored result of a finished wavelength: its fit, its images, and the fingerprint of its data and options."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from services.core.geometry import Record
from services.core.slab.folder import read_folder
from services.core.store import write_atomic, write_record
from services.slab.dictionaries.table import table_file
from services.slab.options import SlabOptions
from services.slab.results.result import SlabFit, Wavelength
from services.transport.numerics import numerics_name

RESULT, IMAGES = "fit.json", "images.npz"
LATER_OPTIONS = ("dictionary", "particle_index", "particle_absorption")
"""Options that version 0.1.0 did not have."""


class StoredResult(Record):
    """Content of ``fit.json`` in a wavelength's folder; it is written last, so a folder that has it is whole."""

    of: str
    """Identifies data and options; see ``fingerprint``."""
    fit: SlabFit


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


def store_result(place: Path, digest: str, wavelength: Wavelength) -> None:
    """Write a wavelength's result into its folder."""
    place.mkdir(parents=True, exist_ok=True)
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        measured=wavelength.measured,
        predicted=wavelength.predicted,
        held_out=wavelength.held_out,
        names=np.array(wavelength.names),
    )
    write_atomic(place / IMAGES, stream.getvalue())
    write_record(place / RESULT, StoredResult(of=digest, fit=wavelength.fit))


def read_result(place: Path) -> StoredResult | None:
    """The result stored in a folder; None where the folder holds no whole result."""
    try:
        return StoredResult.model_validate_json((place / RESULT).read_bytes())
    except (FileNotFoundError, ValidationError):
        return None


def read_result_images(path: Path) -> Images:
    """Images as ``store_result`` wrote them."""
    with np.load(path, allow_pickle=False) as arrays:
        return Images(
            arrays["measured"], arrays["predicted"], arrays["held_out"], tuple(str(name) for name in arrays["names"])
        )
