"""Input files of a laboratory: a JSON file in the project's own vocabulary, or the .rxt file of Prahl's IAD."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from services.core.errors import CaptureInputError
from services.core.files.tables import read_text, require_points
from services.core.files.validation import remedied
from services.core.geometry import Record
from services.core.slab.folder import Cell, Glass, Positive
from services.core.store import read_record

Share = Annotated[float, Field(ge=0, le=1)]
Reading = Annotated[float, Field(ge=0, le=1.2)]
Wall = Annotated[float, Field(ge=0, lt=1)]

RXT_MARK = "IAD1"
RXT_HEADER = 18
"""Count of numbers before the readings of an .rxt file."""
MAX_RXT_COLUMNS = 5
"""Largest number of readings in a line: M_R, M_T, M_U, and the wall's reflectance in either sphere. A single wall
reflectance is that of both spheres, as IAD takes it."""


class Sphere(Record):
    """An integrating sphere used in the substitution method: one reading of the sample, one of the standard."""

    diameter_mm: Positive
    sample_port_mm: Positive = Field(description="diameter")
    third_port_mm: Annotated[float, Field(ge=0)] = Field(description="diameter of the port opposite the sample")
    detector_port_mm: Annotated[float, Field(ge=0)] = Field(description="diameter")
    wall_reflectance: Wall
    detector_reflectance: Share = 0.0
    baffle: bool = Field(
        default=True, description="between sample and detector, so that light must meet the wall first"
    )

    @model_validator(mode="after")
    def _ports_fit(self) -> Sphere:
        for name in ("sample_port_mm", "third_port_mm", "detector_port_mm"):
            if getattr(self, name) >= self.diameter_mm:
                raise ValueError(f"{name} must be below diameter_mm, {self.diameter_mm:g}")
        return self


class TotalsReading(Record):
    """Readings of one wavelength, as shares of the incident power."""

    wavelength_nm: Positive | None = None
    R: Reading
    R_se: Positive | None = None
    T: Reading
    T_se: Positive | None = None
    T_unscattered: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None, description="collimated transmittance"
    )
    T_unscattered_se: Positive | None = None
    source: Literal["normal", "diffuse"] = "normal"
    reflection_wall: Wall | None = Field(default=None, description="of the reflection sphere at this wavelength")
    transmission_wall: Wall | None = Field(default=None, description="of the transmission sphere at this wavelength")


class SphereFile(Record):
    """A sample, the instrument, and its readings."""

    kind: Literal["sphere"]
    units: Literal["mm"]
    cell: Cell
    totals: Annotated[tuple[TotalsReading, ...], Field(min_length=1)]
    g: Annotated[float, Field(gt=-1, lt=1)] = Field(
        default=0.0, description="mean cosine where T_unscattered is not given"
    )
    reflection_sphere: Sphere | None = Field(default=None, description="null where R is corrected already")
    transmission_sphere: Sphere | None = Field(default=None, description="null where T is corrected already")
    standard_reflectance: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1.0, description="of the standard R is told by"
    )
    specular_included: bool = Field(default=True, description="whether R holds the mirror reflection of the faces")
    unscattered_included: bool = Field(default=True, description="whether T holds the unscattered light")

    @model_validator(mode="after")
    def _one_index(self) -> SphereFile:
        if self.cell.boundary == "smooth" and self.cell.index is None:
            raise ValueError("cell.index is null, and totals do not tell it; give the sample's index")
        if self.cell.boundary == "smooth" and (self.cell.index or 0) < self.cell.index_outside:
            raise ValueError(
                f"cell.index is below index_outside, {self.cell.index_outside:g}; only a sample that is denser is"
                " understood"
            )
        names = [reading.wavelength_nm for reading in self.totals]
        if twice := {nm for nm in names if nm is not None and names.count(nm) > 1}:
            raise ValueError(f"wavelength {min(twice):g} nm is listed twice; keep one")
        return self

    def named(self) -> list[tuple[str, TotalsReading]]:
        """Readings by wavelength in nm, or by their number where none is given."""
        return [
            (f"{number}" if reading.wavelength_nm is None else f"{reading.wavelength_nm:g}", reading)
            for number, reading in enumerate(self.totals, start=1)
        ]


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
    return _read_rxt(path) if is_rxt else read_record(path, SphereFile)


def _read_rxt(path: Path) -> SphereFile:
    rows = _numbers(path)
    header: list[float] = []
    while rows and len(header) < RXT_HEADER:
        line, row = rows.pop(0)
        needed = RXT_HEADER - len(header)
        header += row[:needed]
        if row[needed:]:  # the readings may follow in the same line
            rows.insert(0, (line, row[needed:]))
    if len(header) != RXT_HEADER:
        raise CaptureInputError(
            f"{path}: {RXT_HEADER} numbers come before the readings, this file has {len(header)}; complete it."
        )
    index, slide_index, width_mm, slide_mm, _beam_mm, standard = header[:6]
    spheres, columns = int(header[6]), int(header[17])
    if spheres not in {0, 1}:
        raise CaptureInputError(
            f"{path}: readings with {spheres} spheres at once are not understood; measure R and T one after the other."
        )
    if not 2 <= columns <= MAX_RXT_COLUMNS:
        raise CaptureInputError(
            f"{path}: {columns} readings a line are not understood; give M_R and M_T, then M_U and the wall of either"
            " sphere."
        )
    reflection, transmission = (_sphere(header[first : first + 5]) if spheres else None for first in (7, 12))
    slide = {"index": slide_index, "thickness_mm": slide_mm} if slide_mm > 0 and slide_index > 1 else None
    try:
        return SphereFile(
            kind="sphere", units="mm",
            cell=Cell(width_mm=width_mm, index=index, boundary="smooth", glass=Glass(**slide) if slide else None),
            totals=tuple(
                _reading(path, line, one, columns) for line, row in rows for one in _single_readings(row, columns)
            ),
            reflection_sphere=Sphere.model_validate(reflection) if reflection else None,
            transmission_sphere=Sphere.model_validate(transmission) if transmission else None,
            standard_reflectance=standard,
        )  # fmt: skip
    except ValidationError as problem:
        first = problem.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the file"
        raise CaptureInputError(f"{path}: {place}: {remedied(first)}.") from problem


def _numbers(path: Path) -> list[tuple[int, list[float]]]:
    """Lines that hold numbers, each with its number in the file.

    Raises:
        CaptureInputError: a line holds other text, or a number that is not finite.
    """
    rows = []
    text = read_text(path, str(path))
    for number, line in enumerate(text.removeprefix(RXT_MARK).splitlines(), start=1):
        words = line.partition("#")[0].split()
        require_points(words, f"{path}, line {number}:")
        words = " ".join(words).replace(",", " ").split()
        if words and all(word.isalpha() and len(word) == 1 for word in words):
            raise CaptureInputError(
                f"{path}, line {number}: columns named by letters ({' '.join(words)}) are not understood; give the"
                " count of readings a line there, with M_R and M_T first, then M_U and the wall."
            )
        try:
            values = [float(word) for word in words]
        except ValueError as problem:
            raise CaptureInputError(
                f"{path}, line {number}: {' '.join(words)} is not a list of numbers; correct it."
            ) from problem
        if not all(map(math.isfinite, values)):
            raise CaptureInputError(
                f"{path}, line {number}: {' '.join(words)} holds a number that is not finite; correct it."
            )
        if values:
            rows.append((number, values))
    return rows


def _single_readings(row: list[float], columns: int) -> list[list[float]]:
    """Part a line that holds several readings, each with its wavelength where a number is above 1, as IAD does."""
    if len(row) <= columns + 1:
        return [row]
    parts, rest = [], row
    while rest:
        length = columns + (rest[0] > 1)
        parts.append(rest[:length])
        rest = rest[length:]
    return parts if len(parts[-1]) == columns + (parts[-1][0] > 1) else [row]


def _reading(path: Path, line: int, row: list[float], columns: int) -> TotalsReading:
    if len(row) not in {columns, columns + 1}:
        raise CaptureInputError(
            f"{path}, line {line}: {len(row)} numbers where {columns} readings were announced; correct one of them."
        )
    if len(row) > columns and row[0] <= 1:
        raise CaptureInputError(
            f"{path}, line {line}: the first of {len(row)} numbers is {row[0]:g}, which is no wavelength in nm; correct"
            " the line, or the count of readings."
        )
    values = row[-columns:]
    unscattered, reflection_wall, transmission_wall = (*values[2:], None, None, None)[:3]
    try:
        return TotalsReading(
            wavelength_nm=row[0] if len(row) > columns else None,
            R=values[0],
            T=values[1],
            T_unscattered=unscattered or None,  # because 0 means "not measured" in IAD
            reflection_wall=reflection_wall,
            transmission_wall=reflection_wall if transmission_wall is None else transmission_wall,
        )
    except ValidationError as problem:
        first = problem.errors()[0]
        raise CaptureInputError(f"{path}, line {line}: {first['loc'][-1]}: {remedied(first)}.") from problem


def _sphere(numbers: list[float]) -> dict[str, float]:
    names = ("diameter_mm", "sample_port_mm", "third_port_mm", "detector_port_mm", "wall_reflectance")
    return dict(zip(names, numbers, strict=True))
