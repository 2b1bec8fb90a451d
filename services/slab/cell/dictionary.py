"""The dictionary of Gkioulekas et al. (2013), section 4.3: 200 tent phase functions, a pure absorber and vacuum.

A mixture of the atoms is a medium whose scattering per angle, f(theta) = sigma_s p(theta), is linear between 200 knots,
and whose absorption is free. So the unknowns of a fit are f at the knots (per mm and sr) and sigma_a (per mm); weights
are computed from them on request. Tents at 0 and 180 degrees have 1e-4 of the weight of the others, which makes the
first one almost the same atom as vacuum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KNOTS = 200
"""Number of tents, as in the paper."""
SPACING_RAD = math.pi / (KNOTS - 1)
ANGLES_RAD: Array = np.linspace(0.0, math.pi, KNOTS)
LARGEST_EXTINCTION_PER_MM = 200.0
"""Extinction of the scattering atoms and of the absorber (section 4.3)."""


def tent_solid_angles() -> Array:
    """Integral of each tent over the sphere, sr (KNOTS,): 2 pi times the normaliser of the paper's atoms."""
    inner = 2 * np.sin(ANGLES_RAD) * 2 * math.sin(SPACING_RAD / 2) ** 2 / SPACING_RAD
    # 1 - sin(h)/h without cancellation: the series has an error of h^6/5040, below 1e-14.
    h2 = SPACING_RAD**2
    inner[[0, -1]] = h2 / 6 * (1 - h2 / 20)
    return 2 * math.pi * inner


@dataclass(frozen=True)
class Material:
    """A homogeneous medium in the span of the dictionary."""

    scattering: Array
    """sigma_s p(theta) at the knots, per mm and sr (KNOTS,), positive."""
    absorption_per_mm: float

    @property
    def scattering_per_mm(self) -> float:
        """Scattering coefficient sigma_s, per mm."""
        return float(self.scattering @ tent_solid_angles())

    @property
    def extinction_per_mm(self) -> float:
        """Extinction coefficient sigma_t, per mm."""
        return self.scattering_per_mm + self.absorption_per_mm

    @property
    def mean_cosine(self) -> float:
        """First moment g of the phase function."""
        return float(self.scattering @ cosine_moments()) / self.scattering_per_mm

    @property
    def reduced_scattering_per_mm(self) -> float:
        """Reduced scattering coefficient sigma_s' = sigma_s (1 - g), per mm."""
        return self.scattering_per_mm * (1 - self.mean_cosine)

    @property
    def phase_per_sr(self) -> Array:
        """Phase function at the knots, 1/sr (KNOTS,)."""
        return self.scattering / self.scattering_per_mm

    def slope_of_scattering(self) -> Array:
        """Derivatives of sigma_s with respect to ln f at the knots and to sigma_a (KNOTS + 1,)."""
        return np.append(self.scattering * tent_solid_angles(), 0.0)

    def weights(self) -> Array:
        """Simplex weights of the tents, the absorber and vacuum (KNOTS + 2,), Eq. 11 to 13.

        Raises:
            ValueError: the extinction exceeds that of the atoms.
        """
        if self.extinction_per_mm > LARGEST_EXTINCTION_PER_MM:
            raise ValueError(
                f"extinction {self.extinction_per_mm:g}/mm exceeds the dictionary's {LARGEST_EXTINCTION_PER_MM:g}/mm"
            )
        occupied = np.append(self.scattering * tent_solid_angles(), self.absorption_per_mm) / LARGEST_EXTINCTION_PER_MM
        return np.append(occupied, 1 - occupied.sum())


def mixture(weights: Array) -> Material:
    """The medium of simplex weights (KNOTS + 2,): the inverse of ``Material.weights``."""
    atoms = weights[:-1] * LARGEST_EXTINCTION_PER_MM
    return Material(atoms[:-1] / tent_solid_angles(), float(atoms[-1]))


def cosine_moments() -> Array:
    """Integral of each tent times cos(theta) over the sphere, sr (KNOTS,), so that g sigma_s = moments @ f."""
    # sin(t) cos(t) = sin(2t)/2: each half of a tent integrates in closed form with the antiderivatives below.
    left, right = ANGLES_RAD[:-1], ANGLES_RAD[1:]
    mass = (np.cos(2 * left) - np.cos(2 * right)) / 4
    first = (_first(right) - _first(left) - left * mass) / SPACING_RAD
    moments = np.zeros(KNOTS)
    moments[:-1] += mass - first
    moments[1:] += first
    return 2 * math.pi * moments


def _first(angle: Array) -> Array:
    """Antiderivative of t sin(2t)/2."""
    return np.asarray(np.sin(2 * angle) / 8 - angle * np.cos(2 * angle) / 4)


def henyey_greenstein(scattering_per_mm: float, g: float, absorption_per_mm: float) -> Material:
    """HG scattering sampled at the knots and scaled to ``scattering_per_mm``."""
    shape = hg_values(g)
    return Material(scattering_per_mm * shape / float(shape @ tent_solid_angles()), absorption_per_mm)


def hg_values(g: float, angles_rad: Array = ANGLES_RAD) -> Array:
    """HG phase function at the given angles, 1/sr; by default at the knots."""
    return np.asarray((1 - g * g) / (4 * math.pi) / ((1 - g) ** 2 + 4 * g * np.sin(angles_rad / 2) ** 2) ** 1.5)
