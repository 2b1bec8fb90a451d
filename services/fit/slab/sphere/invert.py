"""Absorption and reduced scattering from readings, each with its standard error.

Two totals fix two coefficients. The collimated transmittance, where it was measured, gives the extinction by itself, so
g follows as well; otherwise g is the value in the file, on which the reduced coefficient hardly depends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from services.core.geometry import Record
from services.core.slab.folder import Cell
from services.fit.slab.model.interface import Interface
from services.fit.slab.results.result import Quantity
from services.fit.slab.solve.uncertainty import LARGEST_COEFFICIENT_SHARE
from services.fit.slab.sphere.instrument import Readings, expected
from services.fit.slab.sphere.readings import SphereFile, TotalsReading
from services.fit.slab.sphere.totals import NODES, Optics, slab_totals

Array = NDArray[np.float64]

ASSUMED_SE = 0.005
"""Standard error of R and T where the file gives none, as a share of the incident power: a laboratory's sphere repeats
to about this."""
ASSUMED_UNSCATTERED_SHARE = 0.05
"""Standard error of the collimated transmittance where the file gives none, as a share of its value."""
SEARCH_NODES = 8
"""Number of nodes in the search, enough to tell in which corner of the grid a slab lies."""
SEARCH = tuple(product(np.geomspace(0.02, 60, 8), np.geomspace(0.003, 8, 6)))
"""Grid of reduced scattering and absorption, each times the width, from which a fit takes its start."""
MIN_THICKNESS, MAX_THICKNESS = 1e-6, 1e4
"""Bounds of both, times the width; at the lower one a slab absorbs, or scatters, too little for any reading to show."""
MAX_G, MIN_G = 0.998, -0.95
MAX_READING_ERROR = 2e-5
"""Largest difference between fitted and measured readings of a slab of this index and width; a solution meets them to
1e-10."""
DIFFERENCE = 1e-4
"""Relative step of derivatives."""


class SphereFit(Record):
    """Result of one wavelength."""

    name: str
    sigma_a: Quantity
    sigma_s_reduced: Quantity
    g: Quantity
    sigma_s: Quantity | None
    """Null where the collimated transmittance was not measured, as is sigma_t."""
    sigma_t: Quantity | None
    R: float
    """Measured value, as are T and T_unscattered."""
    T: float
    T_unscattered: float | None
    R_fitted: float
    T_fitted: float
    converged: bool
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Fitted:
    """A fit with the medium and covariance from which ``translucency`` computes the same medium over a backing."""

    fit: SphereFit
    optics: Optics
    covariance: Array
    """Covariance of sigma_a and sigma_s_reduced, in units of mm^-2 (2, 2)."""


def interface_of(cell: Cell) -> Interface:
    """The faces of a cell."""
    outside = cell.index_outside
    if cell.boundary == "matched":
        return Interface(outside, outside)
    assert cell.index is not None  # the file was checked
    glass = (cell.glass.index, cell.glass.thickness_mm) if cell.glass else (None, 0.0)
    return Interface(cell.index, outside, *glass)


def fit_readings(file: SphereFile, nodes: int = NODES) -> list[Fitted]:
    """Fit every wavelength separately."""
    return [_Problem(file, reading, nodes).fit(name) for name, reading in file.named()]


@dataclass(frozen=True)
class _Problem:
    file: SphereFile
    reading: TotalsReading
    nodes: int

    def fit(self, name: str) -> Fitted:
        """Fit the slab whose readings are the measured ones."""
        width, reading = self.file.cell.width_mm, self.reading
        extinction = self.extinction_per_mm()
        measured = np.array([reading.R, reading.T])
        errors = np.array([reading.R_se or ASSUMED_SE, reading.T_se or ASSUMED_SE])

        def residuals(x: Array, nodes: int = self.nodes) -> Array:
            absorption, reduced = np.exp(x)
            return np.asarray((self.readings(absorption, reduced, extinction, nodes) - measured) / errors)

        starts = [np.log(np.array([a, s]) / width) for s, a in SEARCH if extinction is None or a / width < extinction]
        start = min(starts, key=lambda x: float(np.square(residuals(x, SEARCH_NODES)).sum()))
        bounds = np.log(MIN_THICKNESS / width), np.log(MAX_THICKNESS / width)
        solution = least_squares(
            residuals, start, bounds=bounds, diff_step=DIFFERENCE, xtol=1e-10, ftol=1e-14, gtol=1e-12
        )
        absorption, reduced = (float(value) for value in np.exp(solution.x))
        fitted = self.readings(absorption, reduced, extinction, self.nodes)
        return self._result(name, absorption, reduced, extinction, fitted, errors)

    def extinction_per_mm(self) -> float | None:
        """Extinction from the collimated transmittance t^2 x / (1 - r^2 x^2), x = exp(-sigma_t w), all reflections
        summed; None where it was not measured.
        """
        measured = self.reading.T_unscattered
        if measured is None:
            return None
        passes = interface_of(self.file.cell).transmittance(0.0)
        mirror = 1 - passes
        x = 2 * measured / (passes**2 + math.sqrt(passes**4 + (2 * mirror * measured) ** 2))
        return max(-math.log(min(x, 1.0)), MIN_THICKNESS) / self.file.cell.width_mm

    def optics(self, absorption: float, reduced: float, extinction: float | None) -> Optics:
        """The medium; where the extinction is known, g follows from it, clipped to the range of a phase function."""
        g = self.file.g if extinction is None else 1 - reduced / max(extinction - absorption, 1e-12)
        g = min(max(g, MIN_G), MAX_G)
        return Optics(absorption, reduced / (1 - g), g)

    def readings(self, absorption: float, reduced: float, extinction: float | None, nodes: int) -> Array:
        """R and T as the instrument would read them."""
        readings = self.expected(self.optics(absorption, reduced, extinction), nodes)
        return np.array([readings.R, readings.T])

    def expected(self, optics: Optics, nodes: int) -> Readings:
        """All readings of the instrument for a medium."""
        totals = slab_totals(optics, self.file.cell.width_mm, interface_of(self.file.cell), nodes)
        return expected(totals, self.file, self.reading)

    def _result(
        self,
        name: str,
        absorption: float,
        reduced: float,
        extinction: float | None,
        fitted: Array,
        errors: Array,
    ) -> Fitted:
        optics = self.optics(absorption, reduced, extinction)
        covariance, extinction_se = self._covariance(absorption, reduced, extinction, errors)
        se = np.sqrt(np.diag(covariance))
        whole = absorption + reduced
        notes = self._notes(fitted, absorption, reduced, extinction)
        is_off = float(np.abs(fitted - np.array([self.reading.R, self.reading.T])).max()) > MAX_READING_ERROR
        scattering = None if extinction is None else _quantity(optics.scattering_per_mm, float(se[2]), "1/mm")
        fit = SphereFit(
            name=name,
            sigma_a=_quantity(absorption, float(se[0]), "1/mm", whole),
            sigma_s_reduced=_quantity(reduced, float(se[1]), "1/mm"),
            g=_quantity(optics.g, float(se[3]), "1", 0.0 if extinction is None else 1.0),
            sigma_s=scattering,
            sigma_t=None if extinction is None else _quantity(extinction, extinction_se, "1/mm"),
            R=self.reading.R, T=self.reading.T, T_unscattered=self.reading.T_unscattered,
            R_fitted=float(fitted[0]), T_fitted=float(fitted[1]),
            converged=not is_off, notes=notes,
        )  # fmt: skip
        return Fitted(fit, optics, covariance[:2, :2])

    def _covariance(
        self, absorption: float, reduced: float, extinction: float | None, errors: Array
    ) -> tuple[Array, float]:
        """Covariance of sigma_a, sigma_s_reduced, sigma_s and g (4, 4), and the standard error of the extinction."""
        point = np.array([absorption, reduced, extinction or 0.0])
        columns = []
        for k in range(3):
            step = np.zeros(3)
            step[k] = DIFFERENCE * max(point[k], MIN_THICKNESS / self.file.cell.width_mm)
            ends = [self._responses(point + sign * step, extinction is not None) for sign in (1, -1)]
            columns.append((ends[0] - ends[1]) / (2 * step[k]))
        slopes = np.stack(columns, axis=1)  # R, T, sigma_s, g by sigma_a, sigma_s_reduced, sigma_t
        extinction_se = self._extinction_se(extinction)
        # (R, T) = J (sigma_a, sigma_s') + j sigma_t, so an error of the extinction bends both coefficients.
        inverse = np.linalg.pinv(slopes[:2, :2])
        chain = np.concatenate([inverse, -inverse @ slopes[:2, 2:]], axis=1)
        chain = np.concatenate([chain, slopes[2:, :2] @ chain + np.outer(slopes[2:, 2], [0, 0, 1])])
        return (chain * np.append(errors, extinction_se) ** 2) @ chain.T, extinction_se

    def _responses(self, point: Array, knows_extinction: bool) -> Array:
        optics = self.optics(point[0], point[1], point[2] if knows_extinction else None)
        readings = self.expected(optics, self.nodes)
        return np.array([readings.R, readings.T, optics.scattering_per_mm, optics.g])

    def _extinction_se(self, extinction: float | None) -> float:
        measured = self.reading.T_unscattered
        if measured is None or extinction is None:
            return 0.0
        # d ln T_unscattered / d sigma_t is -w but for the second reflection, a part in a thousand.
        share = self.reading.T_unscattered_se / measured if self.reading.T_unscattered_se else ASSUMED_UNSCATTERED_SHARE
        return share / self.file.cell.width_mm

    def _notes(self, fitted: Array, absorption: float, reduced: float, extinction: float | None) -> tuple[str, ...]:
        notes, reading, least = [], self.reading, 2 * MIN_THICKNESS / self.file.cell.width_mm
        if float(np.abs(fitted - np.array([reading.R, reading.T])).max()) > MAX_READING_ERROR:
            measured = f"R = {reading.R:g}, T = {reading.T:g}"
            nearest = f"the nearest one reads {fitted[0]:.4f}, {fitted[1]:.4f}"
            notes.append(
                f"No slab of this width and index reads {measured}; {nearest}: check index, glass, standard and what R"
                " includes."
            )
        if absorption < least:
            notes.append("The readings tell no absorption: what is lost is below what they resolve.")
        if reduced < least:
            notes.append("The readings tell no scattering.")
        if extinction is None:
            notes.append(
                f"g = {self.file.g:g} is what was given, not measured, and the ± do not hold its error: another g may"
                " move the other numbers by more than their ±. The collimated transmittance would tell it."
            )
        elif not MIN_G < 1 - reduced / max(extinction - absorption, 1e-12) < MAX_G:
            notes.append(
                "The collimated transmittance contradicts R and T, as no g fits all three; check it for scattered"
                " light."
            )
        if reading.R_se is None or reading.T_se is None:
            notes.append(f"R and T without a standard error are taken to have {ASSUMED_SE:g}.")
        if reading.T_unscattered is not None and reading.T_unscattered_se is None:
            notes.append(
                f"T_unscattered without a standard error is taken to have {100 * ASSUMED_UNSCATTERED_SHARE:g} % of its"
                " value."
            )
        return tuple(notes)


def _quantity(value: float, se: float, unit: str, reference: float | None = None) -> Quantity:
    """A quantity judged by its own size or by ``reference``; a reference of 0 stands for a value that was given and not
    measured.
    """
    size = abs(value) if reference is None else reference
    determined = size > 0 and se <= LARGEST_COEFFICIENT_SHARE * size
    return Quantity.model_validate({"value": value, "se": se, "unit": unit, "determined": determined})
