"""A shade guide that a laboratory has measured itself: a table in CSV, one row a tab.

::

    tab,geometry,illuminant,L,a,b,se          or      tab,geometry,400,410,...,700,se
    A,45/0,D65,72.1,1.9,17.4,0.3                      A,45/0,0.31,0.33,...,0.62,0.3

``tab`` is a name of the laboratory's own. ``geometry`` is that of the measurement, the same for all tabs.
``illuminant`` is D65 where it is left out. Columns named by wavelengths in nm hold reflectance relative to a perfect
diffuser, and give the colour under D65. ``se``, one standard error of a tab's colour in units of CIELAB, may be left
out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.assets.appearance.instrument import GEOMETRIES
from services.core.colour.cie import D65, lab_from_xyz
from services.core.colour.observer import FIRST_NM, LAST_NM, MAX_GAP_NM, daylight_weights
from services.core.errors import CaptureInputError
from services.core.files.tables import Row, read_rows

Floats = NDArray[np.float64]
LAB = ("L", "a", "b")
ILLUMINANTS = ("D65", "D50")
MIN_TABS = 2
MAX_REFLECTANCE = 1.5
"""Largest reflectance that is taken for a share: at a mirror reflection it may exceed 1, and 100 would be per cent."""


@dataclass(frozen=True)
class Tab:
    """One tab of a guide."""

    name: str
    lab: Floats
    """CIELAB (3,)."""
    se: float
    """One standard error of each of them; 0 where the guide states none."""


@dataclass(frozen=True)
class Guide:
    """All tabs of a guide."""

    name: str
    geometry: str
    illuminant: str
    tabs: tuple[Tab, ...]


def read_guide(path: Path) -> Guide:
    """Read a guide.

    Raises:
        CaptureInputError: it is no such table, or a tab is missing or incomplete; the message names the tab.
    """
    if not path.is_file():
        raise CaptureInputError(f"Guide {path} does not exist; check the path.")
    what = f"Guide {path}"
    rows = read_rows(path, what)
    names = rows[0].cells if rows else ()
    for needed in ("tab", "geometry"):
        if needed not in names:
            raise CaptureInputError(f"{what} has no column {needed}; its first line names the columns.")
    tables = [_cells(row, names, what) for row in rows[1:]]
    for row, cells in zip(rows[1:], tables, strict=True):
        if not cells["tab"]:
            raise CaptureInputError(f"{what} names no tab in line {row.line}; give its name, or remove the line.")
    tab_names = [cells["tab"] for cells in tables]
    if twice := next((name for k, name in enumerate(tab_names) if name in tab_names[:k]), None):
        raise CaptureInputError(f"{what} lists tab {twice} twice; keep one of them.")
    if len(tables) < MIN_TABS:
        raise CaptureInputError(f"{what} lists {len(tables)} tabs, and {MIN_TABS} are the fewest to choose from.")
    geometry = _same(tables, "geometry", tuple(GEOMETRIES), what)
    illuminant = _same(tables, "illuminant", ILLUMINANTS, what) if "illuminant" in names else ILLUMINANTS[0]
    return Guide(path.stem, geometry, illuminant, tuple(_tab(cells, names, illuminant, what) for cells in tables))


def _cells(row: Row, names: tuple[str, ...], what: str) -> dict[str, str]:
    if len(row.cells) > len(names):
        raise CaptureInputError(f"{what} has more cells than columns in line {row.line}; correct that line.")
    return dict(zip(names, (*row.cells, *[""] * (len(names) - len(row.cells))), strict=True))


def _same(tables: list[dict[str, str]], column: str, known: tuple[str, ...], what: str) -> str:
    for cells in tables:
        if cells[column] not in known:
            raise CaptureInputError(
                f"{what} gives tab {cells['tab']} the {column} {cells[column]!r}; known are {', '.join(known)}."
            )
    values = {cells[column] for cells in tables}
    if len(values) > 1:
        raise CaptureInputError(
            f"{what} mixes {column} {' and '.join(sorted(values))}; compare tabs of one {column} at a time."
        )
    return values.pop()


def _tab(cells: Mapping[str, str], names: tuple[str, ...], illuminant: str, what: str) -> Tab:
    tab = cells["tab"]
    se = _number(cells, "se", tab, what) if cells.get("se") else 0.0
    if se < 0:
        raise CaptureInputError(f"{what} gives tab {tab} a standard error below 0; correct it.")
    if all(name in names for name in LAB):
        lab = np.array([_number(cells, name, tab, what) for name in LAB])
        if not 0 <= lab[0] <= 100:
            raise CaptureInputError(f"{what} gives tab {tab} L = {lab[0]:g}, which lies between 0 and 100; correct it.")
        return Tab(tab, lab, se)
    by_node = {float(name): name for name in names if name.replace(".", "", 1).isdigit()}
    nodes = sorted(by_node)
    if not nodes:
        raise CaptureInputError(f"{what} has neither columns L, a, b nor columns named by wavelengths in nm; add them.")
    if nodes[0] > FIRST_NM or nodes[-1] < LAST_NM or max(np.diff(nodes)) > MAX_GAP_NM:
        raise CaptureInputError(
            f"{what} has wavelengths from {nodes[0]:g} to {nodes[-1]:g} nm; a colour needs {FIRST_NM:g} to"
            f" {LAST_NM:g} nm in steps of at most {MAX_GAP_NM:g} nm."
        )
    if illuminant != ILLUMINANTS[0]:
        raise CaptureInputError(f"{what} gives spectra the illuminant {illuminant}; they are seen under D65.")
    spectrum = np.array([_number(cells, by_node[node], tab, what) for node in nodes])
    if spectrum.min() < 0 or spectrum.max() > MAX_REFLECTANCE:
        raise CaptureInputError(
            f"{what} gives tab {tab} a reflectance of {spectrum[np.argmax(np.abs(spectrum))]:g}; write shares between 0"
            " and 1."
        )
    wavelengths, weights = daylight_weights()
    xyz = np.interp(wavelengths, nodes, spectrum) @ weights
    return Tab(tab, lab_from_xyz((xyz * D65 / weights.sum(axis=0))[None], D65)[0], se)


def _number(cells: Mapping[str, str], column: str, tab: str, what: str) -> float:
    text = cells[column]
    if not text:
        raise CaptureInputError(
            f"{what} misses tab {tab}: it has no value of {column}; measure the tab, or remove its line."
        )
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CaptureInputError(f"{what} gives tab {tab} {column} = {text[:40]!r}, which is no number; correct it.")
    return value
