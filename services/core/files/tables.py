"""Read tables and lists of numbers that people and spreadsheets write as text.

The encoding is told by the first bytes, the separator by the first line. With semicolons or tabs between cells, a comma
may be a decimal point.
"""

from __future__ import annotations

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path

from services.core.errors import CaptureInputError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
MAX_BYTES = 64 * 2**20
"""Largest size of a table, bytes."""


@dataclass(frozen=True)
class Row:
    """One line of a table: its number in the file, from 1, and its cells without blanks around them."""

    line: int
    cells: tuple[str, ...]


def read_text(path: Path, what: str) -> str:
    """Read a text file in UTF-8, or in UTF-16 or UTF-32 with a byte order mark.

    Args:
        what: the file and its meaning, in words with which an error message begins.

    Raises:
        CaptureInputError: the file is too large, or of another encoding.
    """
    if path.stat().st_size > MAX_BYTES:
        raise CaptureInputError(f"{what} is larger than {MAX_BYTES // 2**20} MiB; leave out lines that are not needed.")
    content = path.read_bytes()
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as problem:
        raise CaptureInputError(
            f"{what} cannot be read (no text in UTF-8: {problem.reason}); save it as CSV in UTF-8."
        ) from problem
    if "\0" in text:
        raise CaptureInputError(f"{what} holds bytes that are no text; save it as CSV in UTF-8.")
    return text


def read_rows(path: Path, what: str) -> list[Row]:
    """Read the lines of a table that are neither empty nor begin with ``#``.

    Raises:
        CaptureInputError: the file is no table of text.
    """
    text = read_text(path, what)
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    separator = next((one for one in (";", "\t") if one in first), ",")
    rows = []
    try:
        reader = csv.reader(text.splitlines(), delimiter=separator)
        for cells in reader:
            stripped = tuple(cell.strip() for cell in cells)
            if any(stripped) and not stripped[0].startswith("#"):
                rows.append(Row(reader.line_num, tuple(_with_point(one, separator) for one in stripped)))
    except csv.Error as problem:
        raise CaptureInputError(f"{what} is no table ({problem}); save it as CSV in UTF-8.") from problem
    return rows


def require_points(words: list[str], what: str) -> None:
    """Refuse a list of numbers, parted by blanks, in which a comma stands for a decimal point.

    Raises:
        CaptureInputError: one has; the message names it.
    """
    if word := next((one for one in words if _DECIMAL_COMMA.fullmatch(one)), None):
        raise CaptureInputError(
            f"{what} has {word}, whose comma may be a decimal point or part two numbers; write decimal points, and"
            " blanks between numbers."
        )


def _with_point(cell: str, separator: str) -> str:
    return cell.replace(",", ".") if separator != "," and _DECIMAL_COMMA.fullmatch(cell) else cell
