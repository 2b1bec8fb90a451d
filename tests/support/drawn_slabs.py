"""Slabs drawn at random, the readings that the forward model gives for them, and what an inversion makes of these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.slab.solve.uncertainty import LARGEST_COEFFICIENT_SHARE
from services.slab.sphere.invert import ASSUMED_SE, ASSUMED_UNSCATTERED_SHARE, fit_readings, interface_of
from services.slab.sphere.records import SphereFile
from services.slab.sphere.results import SphereFit
from services.slab.sphere.spectrometer import expected
from services.transport.optics.slab_totals import NODES, Optics, slab_totals

WIDTH_MM = 2.0
TRUTH_SHARE = 2e-3
"""Largest distance of a slab that is found from the truth, relative: the readings are exact, so only the ends of the
search differ."""


@dataclass(frozen=True)
class Drawn:
    """A slab, and the file of its readings."""

    file: SphereFile
    optics: Optics

    @property
    def coefficients(self) -> NDArray[np.float64]:
        """Absorption and reduced scattering (2,)."""
        return np.array([self.optics.absorption_per_mm, self.optics.scattering_per_mm * (1 - self.optics.g)])


def drawn(
    index: float, depth: float, albedo: float, g: float, *, collimated: bool = False, glass: bool = False
) -> Drawn:
    """A slab of this optical width, with or without its collimated transmittance among the readings."""
    cell: dict[str, Any] = {"width_mm": WIDTH_MM, "index": index}
    if glass:
        cell["glass"] = {"index": 1.52, "thickness_mm": 1.0}
    optics = Optics(depth * (1 - albedo) / WIDTH_MM, depth * albedo / WIDTH_MM, g)
    blank = SphereFile.model_validate(
        {"kind": "sphere", "units": "mm", "cell": cell, "totals": [{"R": 0.1, "T": 0.1}], "g": 0.0 if collimated else g}
    )
    told = expected(slab_totals(optics, WIDTH_MM, interface_of(blank.cell)), blank, blank.totals[0])
    through = told.T_unscattered if collimated else None
    reading = blank.totals[0].model_copy(update={"R": told.R, "T": told.T, "T_unscattered": through})
    return Drawn(blank.model_copy(update={"totals": (reading,)}), optics)


def random_slab(random: np.random.Generator) -> Drawn:
    """A slab with an index from 1 to 1.6, an optical width from 0.1 to 50 and g from 0 to 0.95.

    What it absorbs of what meets a particle is uniform in one half of all draws, and uniform in its logarithm from 1e-4
    in the other.
    """
    index, depth, g = random.uniform(1, 1.6), np.exp(random.uniform(np.log(0.1), np.log(50))), random.uniform(0, 0.95)
    absorbed = random.uniform() if random.uniform() < 0.5 else np.exp(random.uniform(np.log(1e-4), 0))
    collimated, glass = (bool(random.uniform() < share) for share in (1 / 3, 1 / 3))
    return drawn(index, float(depth), float(1 - absorbed), g, collimated=collimated, glass=glass)


def is_determined(slab: Drawn) -> bool:
    """Whether the readings fix both coefficients, by central differences at the truth: independent of the search."""
    file, reading = slab.file, slab.file.totals[0]
    is_collimated = reading.T_unscattered is not None
    x = np.append(slab.coefficients, slab.optics.extinction_per_mm)

    def read(point: NDArray[np.float64]) -> NDArray[np.float64]:
        absorption, reduced, extinction = point
        g = 1 - reduced / (extinction - absorption) if is_collimated else slab.optics.g
        totals = slab_totals(Optics(absorption, reduced / (1 - g), g), WIDTH_MM, interface_of(file.cell), NODES)
        told = expected(totals, file, reading)
        return np.array([told.R, told.T])

    steps = np.diag(1e-4 * x)
    slopes = np.stack([(read(x + step) - read(x - step)) / (2 * step.sum()) for step in steps], axis=1)
    if np.linalg.cond(slopes[:, :2] * x[:2]) > 1e8:
        return False
    inverse = np.linalg.inv(slopes[:, :2])
    extinction_se = ASSUMED_UNSCATTERED_SHARE / WIDTH_MM if is_collimated else 0.0
    errors = np.column_stack([ASSUMED_SE * inverse, extinction_se * inverse @ slopes[:, 2]])
    se = np.sqrt(np.square(errors).sum(axis=1))
    return bool(se[1] <= LARGEST_COEFFICIENT_SHARE * x[1] and se[0] <= LARGEST_COEFFICIENT_SHARE * x[:2].sum())


def is_at_truth(slab: Drawn, optics: Optics) -> bool:
    """Whether a medium is that of the slab."""
    found = np.array([optics.absorption_per_mm, optics.scattering_per_mm * (1 - optics.g)])
    return bool(np.abs(found - slab.coefficients).max() <= TRUTH_SHARE * slab.coefficients.sum())


def outcome(slab: Drawn) -> tuple[str, SphereFit]:
    """What the inversion says of a slab, and its result.

    ``found`` where it gives the truth and calls it determined; ``open`` where it calls a coefficient not determined;
    else ``missed``.
    """
    (fitted,) = fit_readings(slab.file)
    fit = fitted.fit
    if not fit.converged:
        return "missed", fit
    if not (fit.sigma_a.determined and fit.sigma_s_reduced.determined):
        return "open", fit
    return "found" if is_at_truth(slab, fitted.optics) else "missed", fit
