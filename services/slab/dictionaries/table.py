"""Dictionary ``table``: the user's own phase functions, one in each column of a file in the slab folder.

``dictionary.csv`` has a line of names, the first ``angle_deg``, then a line for each angle; ``dictionary.npy`` is an
array of floats with the same columns. Angles go from 0 to 180 degrees; values are in any unit, as each column is scaled
to a phase function.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.tables import read_rows
from services.slab.cell.dictionary import ANGLES_RAD
from services.slab.dictionaries.chosen import ChosenDictionary, Sample
from services.slab.solve.mixture import Mixtures, unit_atoms

Array = NDArray[np.float64]

FILES = ("dictionary.csv", "dictionary.npy")
FIRST_COLUMN = "angle_deg"
MAX_ATOMS = 200
"""Largest number of atoms, that of the tents: more cannot be told apart at the knots."""
MAX_BYTES = 16 * 2**20
"""Largest size of the file, far more than 200 atoms at a thousand angles need."""


def table(sample: Sample) -> ChosenDictionary:
    """The atoms of the folder's file.

    Raises:
        CaptureInputError: there is no file, or it is no table of phase functions.
    """
    path = table_file(sample.root)
    names, values = _read_csv(path) if path.suffix == ".csv" else _read_npy(path)
    _require_table(path, names, values)
    angles = np.radians(values[:, 0])
    at_knots = np.stack([np.interp(ANGLES_RAD, angles, column) for column in values[:, 1:].T], axis=1)
    if (dark := np.flatnonzero(at_knots.max(axis=0) <= 0)).size:
        raise CaptureInputError(f"{path}: atom {names[dark[0]]} scatters nowhere; remove its column.")
    return ChosenDictionary(Mixtures(unit_atoms(at_knots)), names)


def table_file(root: Path) -> Path:
    """The one file that holds the table.

    Raises:
        CaptureInputError: there is no such file, there are two, or it is too large.
    """
    found = [root / name for name in FILES if (root / name).is_file()]
    if not found:
        raise CaptureInputError(
            f"{root} holds no {' or '.join(FILES)}, which dictionary = table is read from; put one there."
        )
    if len(found) > 1:
        raise CaptureInputError(f"{root} holds both {' and '.join(FILES)}; remove one.")
    if found[0].stat().st_size > MAX_BYTES:
        raise CaptureInputError(f"{found[0]} is larger than {MAX_BYTES // 2**20} MiB; leave out angles or atoms.")
    return found[0]


def _read_csv(path: Path) -> tuple[tuple[str, ...], Array]:
    found = read_rows(path, str(path))
    names, rows = (found[0].cells, found[1:]) if found else ((), [])
    if not names or names[0] != FIRST_COLUMN:
        raise CaptureInputError(f"{path}: the first line must name the columns, the first of them {FIRST_COLUMN}.")
    values = np.zeros((len(rows), len(names)))
    for number, row in enumerate(rows):
        if len(row.cells) != len(names):
            what = f"line {row.line} has {len(row.cells)} values and the first line {len(names)}"
            raise CaptureInputError(f"{path}: {what}; give each angle one value of every atom.")
        try:
            values[number] = [float(cell) for cell in row.cells]
        except ValueError as problem:
            raise CaptureInputError(f"{path}: line {row.line} holds what is no number ({problem}).") from problem
    return names[1:], values


def _read_npy(path: Path) -> tuple[tuple[str, ...], Array]:
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as problem:
        raise CaptureInputError(f"{path} cannot be read ({problem}); save it again with numpy.save.") from problem
    if not isinstance(values, np.ndarray) or values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
        found = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else "an archive"
        raise CaptureInputError(f"{path} holds {found} instead of floats (angles, 1 + atoms); save it as such.")
    return tuple(str(number) for number in range(1, values.shape[1])), values.astype(np.float64)


def _require_table(path: Path, names: tuple[str, ...], values: Array) -> None:
    if not 1 <= len(names) <= MAX_ATOMS:
        raise CaptureInputError(
            f"{path} has {len(names)} atoms; give 1 to {MAX_ATOMS}, each a column after the angles."
        )
    if len(set(names)) < len(names) or "" in names:
        twice = next(name for name in names if not name or names.count(name) > 1)
        raise CaptureInputError(f"{path} has more than one atom, or one without a name, called {twice!r}; rename it.")
    angles = values[:, 0]
    if not np.isfinite(values).all():
        raise CaptureInputError(f"{path} holds a value that is not finite; remove it or replace it.")
    if len(angles) < 2 or angles[0] != 0 or angles[-1] != 180 or not (np.diff(angles) > 0).all():
        raise CaptureInputError(f"{path}: angles must rise from 0 to 180 degrees in the first column.")
    if (values[:, 1:] < 0).any():
        row, column = np.argwhere(values[:, 1:] < 0)[0]
        what = f"atom {names[column]} is negative at {angles[row]:g} degrees"
        raise CaptureInputError(f"{path}: {what}; a phase function is never below zero.")
