"""Lights from a table: name, x, y, z, and intensity where it is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from services.core.calibration.cameras_and_lights import CalibratedLight
from services.core.errors import CaptureInputError
from services.core.files.tables import Row, read_rows
from services.core.files.validation import fault_of, first_error

COLUMNS = ("name", "x", "y", "z")


def read_lights(path: Path, channels: Sequence[str], mm_per_unit: float = 1.0) -> tuple[CalibratedLight, ...]:
    """Read a table of lights whose header is ``name,x,y,z``, and further ``intensity``, or ``intensity_<channel>`` for
    each channel; without these all lights are equally bright, with intensity 1.

    Args:
        path: table with commas, semicolons or tabs.
        channels: channels of the capture.
        mm_per_unit: length of the unit of x, y and z, mm.

    Raises:
        CaptureInputError: a column or a number is missing or wrong; the message names the line.
    """
    if not path.is_file():
        raise CaptureInputError(f"Table of lights {path} does not exist; check its path.")
    head, *rows = read_rows(path, f"Table of lights {path}") or [Row(1, ())]
    own = tuple(f"intensity_{channel}" for channel in channels)
    bright = own if set(own) <= set(head.cells) else ("intensity",) * len(channels)
    extra = sorted(set(head.cells) - {*COLUMNS, *own, "intensity"})
    missing = [column for column in COLUMNS if column not in head.cells]
    if missing or extra:
        what = f"lacks column {missing[0]}" if missing else f"has column '{extra[0]}'"
        raise CaptureInputError(
            f"Table of lights {path} {what}; its first line is name,x,y,z and, where known, intensity or"
            f" {','.join(own)}."
        )
    lights = []
    for row in rows:
        cells = dict(zip(head.cells, row.cells, strict=False))
        if len(row.cells) != len(head.cells):
            raise CaptureInputError(
                f"Line {row.line} of {path} has {len(row.cells)} cells under {len(head.cells)} names; give one each."
            )
        place = [_number(cells[axis], axis, row, path) * mm_per_unit for axis in "xyz"]
        intensity = [_number(cells[column], column, row, path) if column in cells else 1.0 for column in bright]
        fields = {"name": cells["name"], "position_mm": place, "intensity": intensity}
        try:
            lights.append(CalibratedLight.model_validate(fields))
        except ValidationError as problem:
            fault = fault_of(first_error(problem), CalibratedLight)
            raise CaptureInputError(f"Line {row.line} of {path}: {fault}.") from problem
    if not lights:
        raise CaptureInputError(f"Table of lights {path} lists no light; add a line for each.")
    return tuple(lights)


def _number(text: str, column: str, row: Row, path: Path) -> float:
    try:
        return float(text)
    except ValueError as problem:
        raise CaptureInputError(
            f"Line {row.line} of {path} has '{text}' as {column}; give a number with a decimal point."
        ) from problem
