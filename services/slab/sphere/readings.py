"""Input files of a laboratory: a JSON file in the project's own vocabulary, or the .rxt file of Prahl's IAD."""

from __future__ import annotations

from pathlib import Path

from services.core.errors import CaptureInputError
from services.core.store import read_record
from services.slab.sphere.records import SphereFile
from services.slab.sphere.rxt import RXT_MARK, read_rxt


def read_readings(path: Path) -> SphereFile:
    """Read either format; an .rxt file is known by its first four characters.

    Raises:
        CaptureInputError: names the file, the line or field, and what is wrong.
    """
    if not path.is_file():
        raise CaptureInputError(f"{path} does not exist or is a folder; name a JSON or .rxt file of readings.")
    with path.open("rb") as file:
        is_rxt = file.read(len(RXT_MARK)) == RXT_MARK.encode()
    if path.suffix == ".rxt" and not is_rxt:
        raise CaptureInputError(f"{path} does not begin with {RXT_MARK}, as an .rxt file must; check that it is one.")
    if is_rxt:
        return read_rxt(path)
    found = read_record(path, SphereFile)
    if (twice := found.repeated_nm()) is not None:
        raise CaptureInputError(f"{path}: wavelength {twice:g} nm is listed twice; keep one.")
    return found
