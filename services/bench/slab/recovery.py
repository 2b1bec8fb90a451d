"""Recovery of a known material by the fit of noisy images, compared with the truth and the bound of its accuracy."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.bench import Row
from services.bench.slab.plain_photons import plain_images
from services.core.geometry import Record
from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import ANGLES_RAD, Material, tent_solid_angles
from services.slab.cell.rig import rig_of
from services.slab.design.bound import Bound, bound_of
from services.slab.fit import fit_slab
from services.slab.options import SlabOptions
from services.slab.results.result import SlabFit
from services.slab.solve.uncertainty import slopes

Array = NDArray[np.float64]

NOISE = 0.01
"""Relative Poisson noise of a pixel that has its image's mean."""
FINE_RAD: Array = np.radians(np.arange(0, 180.25, 0.5))
"""Angles at which phase functions are compared."""


@dataclass(frozen=True)
class Truth:
    """A medium in a cell."""

    name: str
    folder: SlabFolder
    scattering_per_mm: float
    absorption_per_mm: float
    phase: Callable[[Array], Array]
    """Phase function of the scattering angle in rad; its scale is arbitrary."""

    @property
    def thickness(self) -> float:
        """Optical thickness sigma_t w."""
        return (self.scattering_per_mm + self.absorption_per_mm) * self.folder.cell.width_mm

    def material(self) -> Material:
        """Return the medium as a mixture of the dictionary's tent functions."""
        shape = self.phase(ANGLES_RAD)
        return Material(self.scattering_per_mm * shape / float(shape @ tent_solid_angles()), self.absorption_per_mm)

    def phase_per_sr(self) -> Array:
        """Return the phase function, per sr, at the angles ``FINE_RAD``, normalised by quadrature over them."""
        values = self.phase(FINE_RAD)
        total = 2 * math.pi * float(np.trapezoid(values * np.sin(FINE_RAD), FINE_RAD))
        return np.asarray(values / total)


class Recovered(Record):
    """One quantity of a fit: its truth, estimate, standard error and bound, and whether the fit determined it."""

    truth: float
    value: float
    se: float
    bound: float
    determined: bool


class Recovery(Row):
    """Result for one truth and one seed. ``error`` is the relative L2 error of the phase function over equal steps of
    the angle.
    """

    thickness: float
    albedo: float
    seed: int
    numbers: dict[str, Recovered]
    phase_bound: float
    phase_error_by_sine: float
    """Relative L2 error of the phase function, weighted by the sine of the angle."""
    phase_flagged: float
    """Fraction of the phase function's values that the fit reports as undetermined."""
    fit_error: float
    converged: bool


def photographed(truth: Truth, photons: int, seed: int) -> tuple[Array, Array]:
    """Return images by plain photons with shot noise, and their variances, both (images, rows, columns)."""
    extinction = truth.scattering_per_mm + truth.absorption_per_mm
    images, variances = plain_images(
        truth.folder, extinction, truth.scattering_per_mm / extinction, truth.phase, photons, seed
    )
    # A pixel's estimated variance is correlated with its value, so the variance of the walk is stated as proportional
    # to the image.
    shares = variances.sum(axis=(1, 2)) / images.sum(axis=(1, 2))
    means = images.mean(axis=(1, 2), keepdims=True)
    total = (NOISE**2 * means + shares[:, None, None]) * np.maximum(images, 0.01 * means)
    shot = NOISE * np.sqrt(np.maximum(images, 0) * means)
    return images + shot * np.random.default_rng(seed).normal(size=images.shape), total


def write_images(root: Path, truth: Truth, images: Array, variances: Array) -> None:
    """Write images (images, rows, columns) as the folder of a truth."""
    (root / "slab.json").write_text(truth.folder.model_dump_json())
    for entry, image, variance in zip(truth.folder.images, images, variances, strict=True):
        np.save(root / entry.file, image)
        assert entry.variance_file is not None
        np.save(root / entry.variance_file, variance)


def fitted(truth: Truth, images: Array, variances: Array, seed: int) -> SlabFit:
    """Fit images (images, rows, columns) of a truth's folder."""
    with tempfile.TemporaryDirectory() as place:
        write_images(Path(place), truth, images, variances)
        (fit,) = fit_slab(Path(place), SlabOptions(seed=seed))
    return fit


def recovered(truth: Truth, images: Array, variances: Array, seed: int) -> Recovery:
    """Fit the images and compare the result with truth and bound."""
    fit = fitted(truth, images, variances, seed)
    rig = rig_of(truth.folder, fit.wavelength_nm)
    # Take the part of the variance that the walk adds to the shot noise.
    beside = variances - NOISE**2 * np.maximum(images, 0) * images.mean(axis=(1, 2), keepdims=True)
    if rig.grid.folded:
        beside = 0.25 * (beside[:, : rig.grid.rows][:, ::-1] + beside[:, rig.grid.rows :])
    bound = bound_of(
        rig, truth.material(), noise=NOISE, variances=np.maximum(beside.reshape(len(beside), -1), 0), seed=seed
    )
    return compared(truth, fit, bound, seed)


def compared(truth: Truth, fit: SlabFit, bound: Bound, seed: int) -> Recovery:
    """Return the row of one fit."""
    material = truth.material()
    g = material.mean_cosine
    true = {
        "sigma_t": truth.scattering_per_mm + truth.absorption_per_mm,
        "sigma_s": truth.scattering_per_mm,
        "sigma_a": truth.absorption_per_mm,
        "sigma_s_reduced": truth.scattering_per_mm * (1 - g),
        "g": g,
    }
    numbers = {}
    for name, slope in slopes(material).items():
        estimate = getattr(fit.parameters, name)
        numbers[name] = Recovered(
            truth=true[name],
            value=estimate.value,
            se=estimate.se,
            bound=bound.of(slope),
            determined=estimate.determined,
        )
    phase = truth.phase_per_sr()
    difference = np.interp(FINE_RAD, ANGLES_RAD, np.array(fit.phase.value_per_sr)) - phase
    sines = np.sin(FINE_RAD)
    allowed = np.interp(FINE_RAD, ANGLES_RAD, bound.of_phase(material))
    return Recovery(
        benchmark=truth.name,
        peer="dentine",
        seconds=fit.core_seconds,
        error=_share(difference, phase),
        thickness=truth.thickness,
        albedo=true["sigma_s"] / true["sigma_t"],
        seed=seed,
        numbers=numbers,
        phase_bound=_share(allowed, phase),
        phase_error_by_sine=_share(difference * np.sqrt(sines), phase * np.sqrt(sines)),
        phase_flagged=float(np.mean([not one for one in fit.phase.determined])),
        fit_error=fit.errors.fit_error,
        converged=fit.converged,
    )


def squared_share(residuals: Array, squares: float) -> tuple[float, float]:
    """Return the square of the mean over batches of residuals (B, values), divided by ``squares``, and its standard
    error.

    Only products of different batches count, so that noise does not bias the square. The standard error is the
    jackknife's, which leaves each batch out in turn.
    """
    products = residuals @ residuals.T / squares
    np.fill_diagonal(products, 0)
    count, total = len(residuals), float(products.sum())
    without = (total - 2 * products.sum(axis=1)) / ((count - 1) * (count - 2))
    spread = math.sqrt((count - 1) / count * float(((without - without.mean()) ** 2).sum()))
    return total / (count * (count - 1)), spread


def _share(difference: Array, of: Array) -> float:
    return float(np.sqrt((difference**2).sum() / (of**2).sum()))
