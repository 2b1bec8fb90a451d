"""Absorption and reduced scattering from readings, each with its standard error.

Two totals fix two coefficients. The collimated transmittance, where it was measured, gives the extinction by itself, so
g follows as well; otherwise g is the value in the file, on which the reduced coefficient hardly depends. Where no light
comes through, reflectance alone gives the ratio of both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import Cell
from services.slab.cell.interface import Interface
from services.slab.sphere.records import SphereFile, TotalsReading
from services.slab.sphere.results import (
    OtherSlab,
    SphereFit,
    SphereQuantity,
    left_open,
    not_determined,
    quantity,
)
from services.slab.sphere.search import (
    DIFFERENCE,
    MAX_G,
    MAX_THICKNESS,
    MIN_G,
    MIN_THICKNESS,
    Found,
    KnownExtinction,
    KnownG,
    Slab,
    ratio_that_reads,
    slabs_that_read,
    thick_reflectance,
)
from services.slab.sphere.spectrometer import Readings, expected
from services.transport.optics.slab_totals import NODES, Optics, Totals

Array = NDArray[np.float64]

ASSUMED_SE = 0.005
"""Standard error of R and T where the file gives none, as a share of the incident power: a laboratory's sphere repeats
to about this."""
ASSUMED_UNSCATTERED_SHARE = 0.05
"""Standard error of the collimated transmittance where the file gives none, as a share of its value."""
MAX_DISTANCE = 3.0
"""Largest distance of the readings from those of the nearest slab, in standard errors, at which noise explains it."""
LARGEST_SE = 4.0
"""Standard error, in units of both coefficients together or of one by the width, at which errors are cut off. No
coefficient with such a one is shown."""
MIN_STEP = 1e-3
"""Smallest step of derivatives in units of ``DIFFERENCE`` by the width."""


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
    return list(fitted_readings(file, nodes))


def fitted_readings(file: SphereFile, nodes: int = NODES) -> Iterator[Fitted]:
    """Fit every wavelength separately, each when it is asked for."""
    for name, reading in file.named():
        yield _Problem(file.of(reading), reading, nodes).fit(name)


@dataclass(frozen=True)
class _Problem:
    file: SphereFile
    reading: TotalsReading
    nodes: int

    @property
    def _measured(self) -> Array:
        """R and T; a reading below zero is one of no light."""
        return np.maximum([self.reading.R, self.reading.T or 0.0], 0.0)

    @property
    def _errors(self) -> Array:
        return np.array([self.reading.R_se or ASSUMED_SE, self.reading.T_se or ASSUMED_SE])

    @property
    def _interface(self) -> Interface:
        return interface_of(self.file.cell)

    @property
    def _path(self) -> float:
        """Length of the unscattered beam's path through the slab, in units of its width."""
        return 1 / math.sqrt(1 - self._interface.inside_sine(self.file.incidence_deg) ** 2)

    def fit(self, name: str) -> Fitted:
        """Fit the slab whose readings are the measured ones."""
        extinction = self.extinction_per_mm()
        slab = self._slab(extinction)
        if extinction is None and self._measured[1] == 0 and (thick := self._thick(name, slab)):
            return thick
        found = slabs_that_read(slab, self._measured, self._errors, self._reads)
        fitted = self._result(name, found, extinction)
        is_open = fitted.fit.sigma_a.value is None and fitted.fit.sigma_s_reduced.value is None
        if extinction is None and is_open and fitted.fit.converged and not fitted.fit.other_slabs:
            return self._thick(name, slab) or fitted
        return fitted

    def _slab(self, extinction: float | None) -> Slab:
        width = self.file.cell.width_mm
        unknowns = KnownG(self.file.g, width) if extinction is None else KnownExtinction(extinction)
        return Slab(unknowns, width, self._interface, self.nodes, self.file.incidence_deg)

    def _reads(self, totals: Totals) -> Array:
        readings = expected(totals, self.file, self.reading)
        return np.array([readings.R, readings.T])

    def extinction_per_mm(self) -> float | None:
        """Extinction from the collimated transmittance t^2 x / (1 - r^2 x^2), x = exp(-sigma_t w), all reflections
        summed; None where it was not measured.
        """
        measured = self.reading.T_unscattered
        if measured is None or self.reading.T is None:
            return None
        passes = self._interface.transmittance(self._interface.inside_sine(self.file.incidence_deg))
        mirror = 1 - passes
        x = 2 * measured / (passes**2 + math.sqrt(passes**4 + (2 * mirror * measured) ** 2))
        return max(-math.log(min(x, 1.0)), MIN_THICKNESS) / (self._path * self.file.cell.width_mm)

    def optics(self, absorption: float, reduced: float, extinction: float | None) -> Optics:
        """The medium; where the extinction is known, g follows from it, clipped to the range of a phase function."""
        g = self.file.g if extinction is None else 1 - reduced / max(extinction - absorption, 1e-12)
        g = min(max(g, MIN_G), MAX_G)
        return Optics(absorption, reduced / (1 - g), g)

    def expected(self, optics: Optics) -> Readings:
        """All readings of the instrument for a medium."""
        return expected(self._slab(None).totals(optics), self.file, self.reading)

    def _thick(self, name: str, slab: Slab) -> Fitted | None:
        """Result where nothing comes through, so that R alone is known: the ratio of the coefficients. None where no
        ratio gives R.
        """
        g = min(max(self.file.g, MIN_G), MAX_G)
        if (ratio := ratio_that_reads(slab, g, float(self._measured[0]), self._reads)) is None:
            return None
        ends = [thick_reflectance(slab, g, math.log(ratio) + step, self._reads) for step in (DIFFERENCE, -DIFFERENCE)]
        slope = (ends[1] - ends[0]) / (2 * DIFFERENCE)
        share = min(float(self._errors[0]) / max(slope, 1e-12), LARGEST_SE)
        reduced = MAX_THICKNESS / self.file.cell.width_mm
        fit = self._fit(
            name, np.array([self._measured[0], 0.0]), 0.0, (),
            sigma_a=left_open("1/mm"), sigma_s_reduced=left_open("1/mm"), g=quantity(g, 0.0, "1", judged_by=0.0),
            absorption_ratio=quantity(ratio, share * ratio, "1"),
            notes=(_nothing_through(self.reading),),
        )  # fmt: skip
        # The thickest slab stands for all thick ones, as each of them has the same totals.
        covariance = np.diag([(share * ratio * reduced) ** 2, 0.0])
        return Fitted(fit, Optics(ratio * reduced, reduced / (1 - g), g), covariance)

    def _result(self, name: str, found: list[Found], extinction: float | None) -> Fitted:
        first, others = found[0], found[1:]
        optics = first.optics
        absorption, reduced = optics.absorption_per_mm, optics.scattering_per_mm * (1 - optics.g)
        covariance, extinction_se = self._covariance(absorption, reduced, extinction)
        se = np.sqrt(np.diag(covariance))
        whole, one = absorption + reduced, 1 / self.file.cell.width_mm
        known = extinction is not None
        values = {
            "sigma_a": quantity(absorption, float(se[0]), "1/mm", judged_by=whole, shown_to=max(absorption, one)),
            "sigma_s_reduced": quantity(reduced, float(se[1]), "1/mm", shown_to=max(reduced, one)),
            "g": quantity(optics.g, float(se[3]), "1", judged_by=1.0 if known else 0.0, shown_to=1.0),
        }
        if extinction is not None:
            values["sigma_s"] = quantity(optics.scattering_per_mm, float(se[2]), "1/mm", shown_to=extinction)
            values["sigma_t"] = quantity(extinction, extinction_se, "1/mm")
        distance = float(np.linalg.norm((first.readings - self._measured) / self._errors))
        distance = 0.0 if first.is_solution else distance
        if others or distance > MAX_DISTANCE:
            values = {key: value if key == "sigma_t" else not_determined(value) for key, value in values.items()}
        notes = self._notes(first, distance, absorption, reduced, extinction)
        fit = self._fit(name, first.readings, distance, tuple(others), notes=notes, **values)
        return Fitted(fit, optics, covariance[:2, :2])

    def _fit(
        self, name: str, readings: Array, distance: float, others: tuple[Found, ...], *, notes: tuple[str, ...],
        sigma_a: SphereQuantity, sigma_s_reduced: SphereQuantity, g: SphereQuantity,
        sigma_s: SphereQuantity | None = None, sigma_t: SphereQuantity | None = None,
        absorption_ratio: SphereQuantity | None = None,
    ) -> SphereFit:  # fmt: skip
        reading = self.reading
        slabs = tuple(
            OtherSlab(
                sigma_a=one.optics.absorption_per_mm,
                sigma_s_reduced=one.optics.scattering_per_mm * (1 - one.optics.g),
                g=one.optics.g,
            )
            for one in others
        )
        return SphereFit(
            name=name, sigma_a=sigma_a, sigma_s_reduced=sigma_s_reduced, g=g, sigma_s=sigma_s, sigma_t=sigma_t,
            absorption_ratio=absorption_ratio,
            R=reading.R, T=reading.T, T_unscattered=reading.T_unscattered,
            R_fitted=float(readings[0]), T_fitted=None if reading.T is None else float(readings[1]),
            distance_se=distance, converged=distance <= MAX_DISTANCE, other_slabs=slabs,
            notes=(*notes, *_other_slabs(slabs), *self._assumptions()),
        )  # fmt: skip

    def _covariance(self, absorption: float, reduced: float, extinction: float | None) -> tuple[Array, float]:
        """Covariance of sigma_a, sigma_s_reduced, sigma_s and g (4, 4), and the standard error of the extinction."""
        point = np.array([absorption, reduced, extinction or 0.0])
        least = MIN_STEP / self.file.cell.width_mm
        columns = []
        for k in range(3):
            step = np.zeros(3)
            step[k] = DIFFERENCE * max(point[k], least)
            low = np.maximum(point - step, 0.0)
            ends = [self._responses(one, extinction is not None) for one in (point + step, low)]
            columns.append((ends[0] - ends[1]) / (step[k] + point[k] - low[k]))
        slopes = np.stack(columns, axis=1)  # R, T, sigma_s, g by sigma_a, sigma_s_reduced, sigma_t
        extinction_se = self._extinction_se(extinction)
        # (R, T) = J (sigma_a, sigma_s') + j sigma_t, so an error of the extinction bends both coefficients.
        inverse = self._inverse(slopes[:2, :2], point[:2])
        chain = np.concatenate([inverse, -inverse @ slopes[:2, 2:]], axis=1)
        chain = np.concatenate([chain, slopes[2:, :2] @ chain + np.outer(slopes[2:, 2], [0, 0, 1])])
        return (chain * np.append(self._errors, extinction_se) ** 2) @ chain.T, extinction_se

    def _inverse(self, slopes: Array, point: Array) -> Array:
        """Inverse of the derivatives of R and T (2, 2). A combination of both coefficients that changes no reading
        has a large error there instead of an infinite one.
        """
        scale = max(float(point.sum()), 1 / self.file.cell.width_mm)
        left, singular, right = np.linalg.svd(slopes * scale / self._errors[:, None])
        singular = np.maximum(singular, 1 / LARGEST_SE)
        return np.asarray(scale * (right.T / singular) @ left.T / self._errors)

    def _responses(self, point: Array, knows_extinction: bool) -> Array:
        optics = self.optics(point[0], point[1], point[2] if knows_extinction else None)
        readings = self.expected(optics)
        return np.array([readings.R, readings.T, optics.scattering_per_mm, optics.g])

    def _extinction_se(self, extinction: float | None) -> float:
        measured = self.reading.T_unscattered
        if measured is None or extinction is None:
            return 0.0
        # d ln T_unscattered / d sigma_t is -w but for the second reflection, a part in a thousand.
        share = self.reading.T_unscattered_se / measured if self.reading.T_unscattered_se else ASSUMED_UNSCATTERED_SHARE
        return share / (self._path * self.file.cell.width_mm)

    def _notes(
        self, found: Found, distance: float, absorption: float, reduced: float, extinction: float | None
    ) -> tuple[str, ...]:
        notes, least = [], 2 * MIN_THICKNESS / self.file.cell.width_mm
        if not found.is_solution and distance <= MAX_DISTANCE:
            notes.append(
                "No slab of this width and index reads exactly so; the nearest one is given, whose readings lie less"
                f" than {MAX_DISTANCE:g} standard errors from the measured ones, so noise explains it."
            )
        elif not found.is_solution:
            notes.append(
                "No slab of this width and index reads so, and the nearest one is given: check index, glass, standard"
                " and what R includes."
            )
        if absorption < least:
            notes.append("The readings tell no absorption: what is lost is below what they resolve.")
        if reduced < least:
            notes.append("The readings tell no scattering.")
        if extinction is None:
            notes.append(
                f"g = {self.file.g:g} is what was given, not measured, and the standard errors do not hold its error:"
                " another g may move the other numbers by more than their standard errors. The collimated transmittance"
                " would tell it."
            )
        elif not found.is_solution and not MIN_G < 1 - reduced / max(extinction - absorption, 1e-12) < MAX_G:
            notes.append(
                "The collimated transmittance contradicts R and T, as no g fits all three; check it for scattered"
                " light."
            )
        return tuple(notes)

    def _assumptions(self) -> tuple[str, ...]:
        notes, reading = [], self.reading
        if reading.R_se is None or (reading.T_se is None and reading.T is not None):
            notes.append(f"R and T without a standard error are taken to have {ASSUMED_SE:g}.")
        if reading.T_unscattered is not None and reading.T_unscattered_se is None:
            notes.append(
                f"T_unscattered without a standard error is taken to have {100 * ASSUMED_UNSCATTERED_SHARE:g} % of its"
                " value."
            )
        return tuple(notes)


def _nothing_through(reading: TotalsReading) -> str:
    if reading.T is None:
        return (
            "T was not measured. R alone tells the ratio of absorption and reduced scattering of a slab so thick that"
            " no light comes through, and neither of them by itself."
        )
    return (
        "No light comes through beyond the noise. So the readings tell the ratio of absorption and reduced scattering,"
        " and neither of them by itself; a thinner slab would tell both."
    )


def _other_slabs(slabs: tuple[OtherSlab, ...]) -> tuple[str, ...]:
    return tuple(
        f"Another slab reads the same, σa {one.sigma_a:.4g} and σs′ {one.sigma_s_reduced:.4g} per mm; the readings do"
        " not tell which it is."
        for one in slabs
    )
