"""The .rxt file of Prahl's IAD, as its version 4 reads it: 17 numbers, the legend of the columns, and the readings.

Numbers are parted by blanks, and what stands behind ``#`` is a comment. The legend is a count of readings in a fixed
order, or one letter for each column. Numbers may stand on any lines, as the author's programs read them one after the
other; but a line that ends within a reading is refused unless its numbers stand one on a line, because such a line is
nearly always a slip.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from services.core.errors import CaptureInputError
from services.core.files.tables import read_text, require_points
from services.core.files.validation import remedied
from services.core.slab.folder import Cell, Glass
from services.slab.sphere.records import Sphere, SphereFile, TotalsReading

RXT_MARK = "IAD1"
HEADER = 17
"""Count of numbers before the legend."""
COUNTED = "rtuwWRT"
"""Columns of a legend that is a count, each with its letter; a number above 1 before them is the wavelength."""
READ = frozenset("LrtuwWRTBcCdDEginNeqS")
"""Columns that are understood. The beam's diameter B and the settings of IAD's search, e and q, change nothing here."""
CONSTRAINTS = frozenset("aAbF")
"""Columns by which IAD keeps albedo, absorption, optical thickness or scattering at a value."""


T = TypeVar("T")


@dataclass(frozen=True)
class _Word:
    line: int
    text: str
    whole: str
    """All words of the line."""


@dataclass(frozen=True)
class _Row:
    """One reading: its values by column, and the line it begins on."""

    line: int
    values: dict[str, float]


def read_rxt(path: Path) -> SphereFile:
    """Read an .rxt file.

    Raises:
        CaptureInputError: names the file, the line, and what is wrong.
    """
    words = list(_words(path))
    if len(words) < HEADER or any(_is_letters(word.text) for word in words[:HEADER]):
        count = next((k for k, word in enumerate(words[:HEADER]) if _is_letters(word.text)), len(words))
        raise CaptureInputError(
            f"{path}: {HEADER} numbers and the legend come before the readings, this file has {count}; complete it."
        )
    header = [_number(path, word) for word in words[:HEADER]]
    columns, has_letters, rest = _legend(path, words[HEADER:])
    rows = list(_rows(path, rest, columns, has_letters))
    index, slide_index, width_mm, slide_mm, _beam_mm, standard = header[:6]
    spheres = [_spheres_at_once(path, header[6]), *(int(row.values["S"]) for row in rows if "S" in row.values)]
    has_sphere = any(spheres)
    cell = {"width_mm": width_mm, "index": index, "slide_mm": slide_mm, "slide_index": slide_index}
    file = _checked(path, "", lambda: SphereFile(
        kind="sphere", units="mm", cell=_cell(cell, {}),
        totals=(TotalsReading(R=0),),
        reflection_sphere=_sphere(header[7:12]) if has_sphere else None,
        transmission_sphere=_sphere(header[12:17]) if has_sphere else None,
        standard_reflectance=standard,
    ))  # fmt: skip
    if not rows:
        raise CaptureInputError(f"{path} has no readings behind its legend; add one.")
    readings = tuple(
        _checked(path, f", line {row.line}", partial(_reading, row.values, cell, spheres[0])) for row in rows
    )
    # Validated anew, because a column may give a cell of its own.
    return _checked(path, "", lambda: SphereFile.model_validate(dict(file) | {"totals": readings}))


def _words(path: Path) -> Iterator[_Word]:
    """The words of the file without its comments; letters that stand together are parted."""
    text = read_text(path, str(path))
    for number, line in enumerate(text.removeprefix(RXT_MARK).splitlines(), start=1):
        words = line.partition("#")[0].split()
        require_points(words, f"{path}, line {number}:")
        whole = " ".join(words).replace(",", " ")
        for word in whole.split():
            yield _Word(number, word, whole)


def _is_letters(text: str) -> bool:
    return text.replace("-", "").isalpha() and text.lower() not in {"nan", "inf", "infinity", "-inf", "-nan"}


def _number(path: Path, word: _Word) -> float:
    try:
        value = float(word.text)
    except ValueError:
        raise CaptureInputError(
            f"{path}, line {word.line}: {word.whole} is not a list of numbers; correct it."
        ) from None
    if not math.isfinite(value):
        raise CaptureInputError(
            f"{path}, line {word.line}: {word.whole} holds a number that is not finite; correct it."
        )
    return value


def _legend(path: Path, words: list[_Word]) -> tuple[str, bool, list[_Word]]:
    """Columns by their letters, whether the file names them so, and the words behind the legend."""
    if not words:
        raise CaptureInputError(f"{path} ends before the legend; give the count of readings, or a letter a column.")
    place = f"{path}, line {words[0].line}"
    if not _is_letters(words[0].text):
        count = _number(path, words[0])
        if count not in range(1, len(COUNTED) + 1):
            raise CaptureInputError(
                f"{place}: {words[0].text} readings a line are not understood; give 1 to {len(COUNTED)}, which are"
                " M_R, M_T, M_U, the wall of either sphere and the standard of either."
            )
        return COUNTED[: int(count)], False, words[1:]
    end = next((k for k, word in enumerate(words) if not _is_letters(word.text)), len(words))
    columns = "".join(word.text.replace("-", "") for word in words[:end])
    if twice := next((letter for letter in columns if columns.count(letter) > 1), None):
        raise CaptureInputError(f"{place}: column {twice} is named twice; name each column once.")
    if fixed := next((letter for letter in columns if letter in CONSTRAINTS), None):
        raise CaptureInputError(
            f"{place}: column {fixed} keeps a coefficient at a value, and both are measured here; leave it out."
        )
    if unknown := next((letter for letter in columns if letter not in READ), None):
        raise CaptureInputError(
            f"{place}: {unknown} is no letter of a column ({' '.join(sorted(READ, key=str.lower))} are understood);"
            " correct it."
        )
    if "r" not in columns:
        raise CaptureInputError(f"{place}: no column is r, the reflectance M_R; add it.")
    return columns, True, words[end:]


def _rows(path: Path, words: list[_Word], columns: str, has_letters: bool) -> Iterator[_Row]:
    """Part the numbers behind the legend into readings."""
    lines = Counter(word.line for word in words)
    one_a_line = set(lines.values()) == {1}
    at = 0
    while at < len(words):
        first = words[at]
        value = _number(path, first)
        begins_line = at == 0 or words[at - 1].line != first.line
        if not has_letters and value <= 1 and begins_line and lines[first.line] == len(columns) + 1 > 2:
            raise CaptureInputError(
                f"{path}, line {first.line}: the first of {len(columns) + 1} numbers is {value:g}, which is no"
                " wavelength in nm; correct the line, or the count of readings."
            )
        names = columns if has_letters or value <= 1 else f"L{columns}"
        own = words[at : at + len(names)]
        crosses = own[-1].line != first.line and not one_a_line
        if len(own) < len(names) or crosses:
            here = lines[first.line]
            raise CaptureInputError(
                f"{path}, line {first.line}: {here} numbers where {len(columns)} "
                + ("columns were named" if has_letters else "readings were announced")
                + "; correct one of them."
            )
        values = dict(zip(names, (_number(path, word) for word in own), strict=True))
        if "L" in values and values["L"] <= 1:
            raise CaptureInputError(
                f"{path}, line {first.line}: {values['L']:g} is no wavelength in nm; correct the line, or the legend."
            )
        yield _Row(first.line, values)
        at += len(names)


def _reading(values: dict[str, float], cell: dict[str, float], spheres: int) -> TotalsReading:
    """One reading; zero and less stands for a transmittance that was not measured, as the author takes it.

    Raises:
        ValueError: a value is not understood; the message says which.
    """
    if values.get("E", 0) != 0:
        raise ValueError("column E says that the slides absorb, which is not understood; use clear slides")
    count = values.get("S", spheres)
    if count not in {0, 1}:
        raise ValueError(f"{count:g} spheres at once are not understood; measure R and T one after the other")
    own: dict[str, Any] = {
        "wavelength_nm": values.get("L"),
        "R": values["r"],
        "T": values.get("t") or None,
        "T_unscattered": unscattered if (unscattered := values.get("u", 0)) > 0 else None,
        "reflection_wall": values.get("w"),
        "transmission_wall": values.get("W", values.get("w")),
        "standard_reflectance": values.get("R"),
        "transmission_standard": values.get("T"),
        "g": values.get("g"),
        "incidence_deg": values.get("i"),
        "specular_share": values.get("c"),
        "unscattered_share": values.get("C"),
        "cell": _cell(cell, values) if values.keys() & {"d", "D", "n", "N"} else None,
        "without_sphere": count == 0,
    }
    return TotalsReading.model_validate(own)


def _cell(header: dict[str, float], values: dict[str, float]) -> Cell:
    width_mm, index = values.get("d", header["width_mm"]), values.get("n", header["index"])
    slide_mm, slide_index = values.get("D", header["slide_mm"]), values.get("N", header["slide_index"])
    glass = Glass(index=slide_index, thickness_mm=slide_mm) if slide_mm > 0 and slide_index > 1 else None
    return Cell(width_mm=width_mm, index=index, boundary="smooth", glass=glass)


def _sphere(numbers: list[float]) -> Sphere:
    names = ("diameter_mm", "sample_port_mm", "third_port_mm", "detector_port_mm", "wall_reflectance")
    return Sphere.model_validate(dict(zip(names, numbers, strict=True)))


def _spheres_at_once(path: Path, count: float) -> int:
    if count not in {0, 1}:
        raise CaptureInputError(
            f"{path}: readings with {count:g} spheres at once are not understood; measure R and T one after the other."
        )
    return int(count)


def _checked(path: Path, place: str, make: Callable[[], T]) -> T:
    """What ``make`` returns.

    Raises:
        CaptureInputError: it refused a value; the message names the file and the value.
    """
    try:
        return make()
    except ValidationError as problem:
        first = problem.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "the file"
        raise CaptureInputError(f"{path}{place}: {name}: {remedied(first)}.") from problem
    except ValueError as problem:
        raise CaptureInputError(f"{path}{place}: {problem}.") from problem
