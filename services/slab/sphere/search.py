"""Search for the slabs whose readings are the measured ones, from several starts.

A coarse grid of slabs is computed once for all readings of one cell. Each of its cells that is nearer to the readings
than its neighbours is a start. Reflectance and the logarithm of transmittance are solved for, because the logarithm is
nearly linear in the thickness: a start that is too thick still sees in which direction the solution lies, where its
transmittance itself has no slope. Starts that end at different slabs show that the readings have several.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import brentq, least_squares

from services.slab.cell.interface import Interface
from services.transport.optics.slab_totals import Optics, Totals, slab_totals

Array = NDArray[np.float64]

MIN_THICKNESS, MAX_THICKNESS = 1e-6, 1e4
"""Bounds of absorption and reduced scattering, each times the width; at the lower one a slab absorbs, or scatters, too
little for any reading to show."""
MAX_G, MIN_G = 0.998, -0.95
GRID_NODES = 8
"""Number of nodes on the grid, enough to tell in which cells a slab may lie."""
GRID = (20, 16)
"""Number of places of the grid along either unknown."""
MAX_STARTS = 6
"""Largest number of places of the grid from which a search starts, the nearest ones first."""
MAX_READING_ERROR = 1e-6
"""Largest difference between the readings of a slab that is found and the measured ones; a solution meets them to
1e-10."""
FAINTEST = 1e-12
"""Transmittance that is added before the logarithm is taken."""
R_SCALE = 0.05
"""Difference of reflectance that weighs as much as a factor of e in transmittance."""
DIFFERENCE = 1e-4
"""Step of derivatives, in logarithms."""
APART = 1e-3
"""Relative difference of coefficients, beyond which two ends of a search are two slabs."""
RATIOS = (1e-9, 1e5)
"""Range of absorption over reduced scattering in which the ratio of a thick slab is looked for."""


@dataclass(frozen=True)
class KnownG:
    """Slabs of a known mean cosine; the unknowns are the logarithms of absorption and reduced scattering, each times
    the width.
    """

    g: float
    width_mm: float

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of both unknowns."""
        low, high = math.log(MIN_THICKNESS), math.log(MAX_THICKNESS)
        return np.array([low, low]), np.array([high, high])

    @property
    def axes(self) -> tuple[Array, Array]:
        """Places of the grid along either unknown."""
        return np.log(np.geomspace(1e-4, 100, GRID[0])), np.log(np.geomspace(1e-3, 300, GRID[1]))

    def optics(self, x: Array) -> Optics:
        """The medium."""
        absorption, reduced = np.exp(x) / self.width_mm
        g = min(max(self.g, MIN_G), MAX_G)
        return Optics(float(absorption), float(reduced) / (1 - g), g)


@dataclass(frozen=True)
class KnownExtinction:
    """Slabs of a known extinction; the unknowns are the logarithms of scattering over absorption and of 1 − g."""

    extinction_per_mm: float

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of both unknowns."""
        return np.array([-16.0, math.log(1 - MAX_G)]), np.array([16.0, math.log(1 - MIN_G)])

    @property
    def axes(self) -> tuple[Array, Array]:
        """Places of the grid along either unknown."""
        return np.linspace(-6, 9, GRID[0]), np.linspace(math.log(0.005), math.log(1.9), GRID[1])

    def optics(self, x: Array) -> Optics:
        """The medium."""
        absorbed = 1 / (1 + math.exp(x[0]))
        g = min(max(1 - math.exp(x[1]), MIN_G), MAX_G)
        return Optics(self.extinction_per_mm * absorbed, self.extinction_per_mm * (1 - absorbed), g)


Unknowns = KnownG | KnownExtinction
Reads = Callable[[Totals], Array]
"""R and T that an instrument reads of a slab with these totals (2,)."""


@dataclass(frozen=True)
class Slab:
    """The slab of a cell: how it is looked for and how it is computed."""

    unknowns: Unknowns
    width_mm: float
    interface: Interface
    nodes: int
    incidence_deg: float = 0.0

    def totals(self, optics: Optics) -> Totals:
        """Totals of a medium in this cell."""
        return slab_totals(optics, self.width_mm, self.interface, self.nodes, self.incidence_deg)


@dataclass(frozen=True)
class Found:
    """A slab that the search ended at, and what it reads."""

    optics: Optics
    readings: Array
    is_solution: bool
    """Whether it reads what was measured; otherwise it is the nearest slab."""


def slabs_that_read(slab: Slab, measured: Array, errors: Array, reads: Reads) -> list[Found]:
    """All slabs found that give the readings, the one with the least absorption first; or the nearest one alone.

    Args:
        slab: the cell, and what is unknown.
        measured: R and T (2,), neither below zero.
        errors: their standard errors (2,), by which the nearest slab is the nearest.
        reads: the instrument.
    """
    bounds = slab.unknowns.bounds
    goal = _compressed(measured)

    def readings(x: Array) -> Array:
        return reads(slab.totals(slab.unknowns.optics(x)))

    def solve(residuals: Callable[[Array], Array], start: Array) -> Array:
        return np.asarray(
            least_squares(
                residuals, start, bounds=bounds, jac=lambda x: _slopes(residuals, x, bounds[1]),
                xtol=1e-12, ftol=1e-15, gtol=1e-13, max_nfev=80,
            ).x
        )  # fmt: skip

    starts = _starts(slab, goal, reads)
    ends = [solve(lambda x: _compressed(readings(x)) - goal, start) for start in starts]
    solutions: list[Found] = []
    for x in ends:
        found = _found(slab, x, readings(x), measured)
        if found.is_solution and not any(_same(found.optics, other.optics) for other in solutions):
            solutions.append(found)
    if solutions:
        return sorted(solutions, key=lambda found: found.optics.absorption_per_mm)

    def distance(x: Array) -> float:
        return float(np.square((readings(x) - measured) / errors).sum())

    nearest = [
        solve(lambda x: (readings(x) - measured) / errors, x) for x in sorted([*ends, *starts], key=distance)[:3]
    ]
    best = min([*nearest, *ends], key=distance)
    return [_found(slab, best, readings(best), measured)]


def ratio_that_reads(slab: Slab, g: float, reflectance: float, reads: Reads) -> float | None:
    """Absorption over reduced scattering of a slab so thick that nothing comes through; None where no ratio reads so.
    More absorption always reads darker, so there is at most one.
    """

    def difference(log_ratio: float) -> float:
        return float(thick_reflectance(slab, g, log_ratio, reads) - reflectance)

    low, high = (math.log(ratio) for ratio in RATIOS)
    if difference(low) < 0 or difference(high) > 0:
        return None
    return math.exp(float(brentq(difference, low, high, xtol=1e-12)))


def thick_reflectance(slab: Slab, g: float, log_ratio: float, reads: Reads) -> float:
    """The reading R of a slab through which nothing comes, by the logarithm of absorption over reduced scattering."""
    optics = Optics(math.exp(log_ratio), 1 / (1 - g), g)
    return float(reads(slab_totals(optics, math.inf, slab.interface, slab.nodes, slab.incidence_deg))[0])


def _compressed(readings: Array) -> Array:
    """R and the logarithm of T, in units in which both are searched."""
    return np.array([readings[0] / R_SCALE, math.log(max(float(readings[1]), 0.0) + FAINTEST)])


def _slopes(residuals: Callable[[Array], Array], x: Array, upper: Array) -> Array:
    """Derivatives of residuals by forward or, at the upper bound, backward differences (2, 2)."""
    here = residuals(x)
    columns = []
    for k in range(len(x)):
        step = DIFFERENCE if x[k] + DIFFERENCE <= upper[k] else -DIFFERENCE
        moved = x.copy()
        moved[k] += step
        columns.append((residuals(moved) - here) / step)
    return np.stack(columns, axis=1)


def _starts(slab: Slab, goal: Array, reads: Reads) -> list[Array]:
    """Places of the grid that are nearer to the readings than their neighbours, the nearest first."""
    places, totals = _grid(slab.unknowns, slab.width_mm, slab.interface, slab.incidence_deg)
    found = np.array([_compressed(reads(one)) for one in totals])
    misfit = np.square(found - goal).sum(axis=1).reshape(GRID)
    is_least = (misfit == minimum_filter(misfit, size=3, mode="nearest")).reshape(-1)
    order = np.argsort(misfit.reshape(-1))
    return [places[k] for k in order if is_least[k]][:MAX_STARTS]


@lru_cache(maxsize=8)
def _grid(
    unknowns: Unknowns, width_mm: float, interface: Interface, incidence_deg: float
) -> tuple[tuple[Array, ...], tuple[Totals, ...]]:
    first, second = unknowns.axes
    places = tuple(np.array([a, b]) for a in first for b in second)
    return places, tuple(
        slab_totals(unknowns.optics(x), width_mm, interface, GRID_NODES, incidence_deg) for x in places
    )


def _found(slab: Slab, x: Array, readings: Array, measured: Array) -> Found:
    # A transmittance below the tolerance must agree in its logarithm, too, or any thick slab would pass.
    is_equal = float(np.abs(readings - measured).max()) <= MAX_READING_ERROR
    logarithms = _compressed(readings)[1], _compressed(measured)[1]
    is_solution = is_equal and abs(logarithms[0] - logarithms[1]) < APART
    return Found(slab.unknowns.optics(x), readings, is_solution)


def _same(one: Optics, other: Optics) -> bool:
    pairs = (
        (one.absorption_per_mm, other.absorption_per_mm),
        (one.scattering_per_mm * (1 - one.g), other.scattering_per_mm * (1 - other.g)),
    )
    whole = max(one.extinction_per_mm, other.extinction_per_mm)
    return all(abs(a - b) <= APART * max(abs(a), abs(b), APART * whole) for a, b in pairs)
