"""Unknowns of a dictionary with few atoms: f = D w with weights w >= 0, and sigma_a >= 0.

Each atom is a phase function p_m at the knots, so that w_m is its part of sigma_s. Neighbouring atoms are much alike:
the bounds choose few of them, and a wide prior keeps the standard errors of the others finite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from services.slab.cell.dictionary import KNOTS, Material, tent_solid_angles
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.prior import Quadratic

Array = NDArray[np.float64]

SHARE = 1.0
"""Standard deviation of a weight's prior, as a share of sigma_s: one atom may be the whole medium. With 0.1, which the
evidence preferred more often than not, one lobe was spread over its neighbours, and its weight came out at half with a
± of a tenth."""
WEAK_SHARE = 10.0
"""The same for the prior by which values are flagged."""
FIRST_SPREAD = 0.1
"""Share of sigma_s that is spread evenly over all atoms at the beginning, so that images depend on each."""
DARKEST = 1e-5
"""Smallest f, as a share of its mean over all directions, because scores divide by f and a table may hold zeros."""
SMALLEST_PER_MM = 1e-6
"""Smallest sigma_s to which ``DARKEST`` is applied."""
LARGEST_SHARE = 0.5
"""Share of sigma_s by which an unknown may change in one step."""
PIVOT = 1e-10
"""Term added to the diagonal of a matrix that is scaled to ones there, so that its Cholesky factor exists."""


@dataclass(frozen=True)
class Mixture(Material):
    """A medium made of a dictionary's atoms."""

    atom_weights: Array
    """Part of sigma_s of each atom, per mm (M,)."""


@dataclass(frozen=True)
class Mixtures:
    """Coordinates of a mix; see ``coordinates.Coordinates``. Unknowns are the weights of M atoms and sigma_a."""

    atoms: Array
    """Phase functions at the knots, 1/sr (KNOTS, M); see ``unit_atoms``."""

    def initial_medium(self, guess: Material) -> Mixture:
        """The mix that is nearest to the guess, by power per angle, with a little of every atom."""
        root = np.sqrt(tent_solid_angles())
        nearest, _ = optimize.nnls(self.atoms * root[:, None], guess.scattering * root)
        sigma_s, count = guess.scattering_per_mm, self.atoms.shape[1]
        nearest *= sigma_s / max(float(nearest.sum()), 1e-300)
        weights = (1 - FIRST_SPREAD) * nearest + FIRST_SPREAD * sigma_s / count
        return self.material_at(np.append(weights, guess.absorption_per_mm))

    def unknowns(self, material: Material) -> Array:
        """Weights and sigma_a (M + 1,)."""
        assert isinstance(material, Mixture)
        return np.append(material.atom_weights, material.absorption_per_mm)

    def material_at(self, x: Array) -> Mixture:
        """The mix with these unknowns, with f nowhere zero."""
        weights = np.maximum(x[:-1], 0)
        darkest = DARKEST * max(float(weights.sum()), SMALLEST_PER_MM) / (4 * np.pi)
        return Mixture(np.maximum(self.atoms @ weights, darkest), max(float(x[-1]), 0.0), weights)

    def chain(self, material: Material) -> Array:
        """Derivatives of ln f with respect to the weights, which are the atoms divided by f (UNKNOWNS, M + 1)."""
        matrix = np.zeros((UNKNOWNS, self.atoms.shape[1] + 1))
        matrix[:KNOTS, :-1] = self.atoms / material.scattering[:, None]
        matrix[KNOTS, -1] = 1
        return matrix

    def scale(self, material: Material, quadratic: Quadratic, *, sharp: bool) -> float:  # noqa: ARG002 - one for all
        """Standard deviation of a weight, per mm."""
        return SHARE * material.scattering_per_mm

    def precision(self, scale: float | Array) -> Array:
        """Inverse covariance of weights about zero; the absorption has a flat prior."""
        return np.diag(np.append(np.full(self.atoms.shape[1], scale**-2.0), 0.0))

    def pull_covariance(self, material: Material, quadratic: Quadratic, scale: float | Array) -> Array:  # noqa: ARG002 - one for all
        """That of weights of the prior's own size."""
        return self.precision(scale)

    def weak_precision(self, material: Material) -> Array:
        """The same for weights that may all be many times those of the medium."""
        return self.precision(WEAK_SHARE * material.scattering_per_mm)

    def broad_directions(self) -> Array:
        """No directions, because atoms are few and each is judged by its bound."""
        return np.zeros((self.atoms.shape[1] + 1, 0))

    def broad_standard_deviations(self, material: Material) -> Array:  # noqa: ARG002 - there are no such directions
        """No directions."""
        return np.zeros(0)

    def linear_change(self, change: Array) -> Array:
        """The step itself, as f is linear in the weights."""
        return change

    def similarity_step(self, change: Array, material: Material) -> Array:  # noqa: ARG002 - weights are few and seen
        """The step itself, as weights are few."""
        return change

    def minimum(self, matrix: Array, right: Array) -> Array:
        """The minimum by non-negative least squares: with matrix = R^T R, |R x - R^-T right|^2 is least."""
        # Scale the diagonal to 1, because an absorption and a weight differ in size.
        unit = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        upper = np.linalg.cholesky(unit[:, None] * matrix * unit + PIVOT * np.eye(len(unit))).T
        x, _ = optimize.nnls(upper, np.linalg.solve(upper.T, unit * right))
        return np.asarray(unit * x)

    def clipped_step(self, change: Array, material: Material) -> Array:
        """The step with each unknown limited by itself; between two points without a negative weight there is none."""
        most = LARGEST_SHARE * material.scattering_per_mm
        return np.clip(change, -most, most)

    def is_at_bound(self, x: Array) -> NDArray[np.bool_]:
        """Mask (M + 1,) of the weights and the absorption that are zero."""
        return x <= 0


def unit_atoms(values: Array) -> Array:
    """Phase functions (KNOTS, M) from values at the knots in any unit."""
    return np.asarray(values / (tent_solid_angles() @ values))
