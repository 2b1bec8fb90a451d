"""Unknowns of a dictionary with few atoms: f = D w with weights w >= 0, and sigma_a >= 0.

Each atom is a phase function p_m at the knots, so that w_m is the part of sigma_s that is its own. Atoms next to each
other are much alike: the bounds choose few of them, and a wide ridge keeps the others' ± finite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from services.fit.slab.model.dictionary import KNOTS, Material, tent_solid_angles
from services.fit.slab.solve.normal import UNKNOWNS
from services.fit.slab.solve.prior import Quadratic

Array = NDArray[np.float64]

SHARE = 1.0
"""Standard deviation of a weight's prior, as a share of sigma_s: an atom may be all there is. With 0.1, which the
evidence took more often than not, one lobe was spread over its neighbours, and its weight came out at half with a ± of
a tenth."""
WEAK_SHARE = 10.0
"""The same of the prior by which values are flagged."""
FIRST_SPREAD = 0.1
"""Share of sigma_s that all atoms have alike at the beginning, so that light tells of each."""
DARKEST = 1e-5
"""Of f, as a share of its mean over all directions: scores divide by f, and a table may hold zeros."""
SMALLEST_PER_MM = 1e-6
"""Of sigma_s from which ``DARKEST`` is reckoned at least."""
LARGEST_SHARE = 0.5
"""Of sigma_s by which an unknown may change in one step."""
PIVOT = 1e-10
"""Added to the diagonal of a matrix that is scaled to ones there, so that it can be taken apart by Cholesky."""


@dataclass(frozen=True)
class Mixture(Material):
    """A medium made of atoms."""

    atom_weights: Array
    """Part of sigma_s of each atom, per mm (M,)."""


@dataclass(frozen=True)
class Mixtures:
    """See ``coordinates.Coordinates``; unknowns are the weights of M atoms and sigma_a."""

    atoms: Array
    """Phase functions at the knots, 1/sr (KNOTS, M); see ``unit_atoms``."""

    def begun(self, guess: Material) -> Mixture:
        """The mix that is nearest to the guess, by power per angle, and a little of every atom."""
        root = np.sqrt(tent_solid_angles())
        nearest, _ = optimize.nnls(self.atoms * root[:, None], guess.scattering * root)
        sigma_s, count = guess.scattering_per_mm, self.atoms.shape[1]
        nearest *= sigma_s / max(float(nearest.sum()), 1e-300)
        weights = (1 - FIRST_SPREAD) * nearest + FIRST_SPREAD * sigma_s / count
        return self.material_at(np.append(weights, guess.absorption_per_mm))

    def unknowns(self, material: Material) -> Array:
        """Weights and sigma_a."""
        assert isinstance(material, Mixture)
        return np.append(material.atom_weights, material.absorption_per_mm)

    def material_at(self, x: Array) -> Mixture:
        """The mix; nowhere quite dark."""
        weights = np.maximum(x[:-1], 0)
        darkest = DARKEST * max(float(weights.sum()), SMALLEST_PER_MM) / (4 * np.pi)
        return Mixture(np.maximum(self.atoms @ weights, darkest), max(float(x[-1]), 0.0), weights)

    def chain(self, material: Material) -> Array:
        """Derivatives of ln f by the weights are the atoms divided by f."""
        matrix = np.zeros((UNKNOWNS, self.atoms.shape[1] + 1))
        matrix[:KNOTS, :-1] = self.atoms / material.scattering[:, None]
        matrix[KNOTS, -1] = 1
        return matrix

    def scale(self, material: Material, quadratic: Quadratic, *, sharp: bool) -> float:  # noqa: ARG002 - one for all
        """Standard deviation of a weight, per mm."""
        return SHARE * material.scattering_per_mm

    def precision(self, scale: float | Array) -> Array:
        """Of weights about zero; nothing is assumed of the absorption."""
        return np.diag(np.append(np.full(self.atoms.shape[1], scale**-2.0), 0.0))

    def weak_precision(self, material: Material) -> Array:
        """Of weights that may all be many times what there is."""
        return self.precision(WEAK_SHARE * material.scattering_per_mm)

    def broad(self) -> Array:
        """None: atoms are few, and each is judged by its bound."""
        return np.zeros((self.atoms.shape[1] + 1, 0))

    def reach(self, material: Material) -> Array:  # noqa: ARG002 - there are no such directions
        """None."""
        return np.zeros(0)

    def similar(self, change: Array, material: Material) -> Array:  # noqa: ARG002 - weights are few and seen
        """The step itself."""
        return change

    def minimum(self, matrix: Array, right: Array) -> Array:
        """By non-negative least squares: with matrix = R^T R, |R x - R^-T right|^2 is least."""
        # In units in which the diagonal is 1, as an absorption and a weight differ.
        unit = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        upper = np.linalg.cholesky(unit[:, None] * matrix * unit + PIVOT * np.eye(len(unit))).T
        x, _ = optimize.nnls(upper, np.linalg.solve(upper.T, unit * right))
        return np.asarray(unit * x)

    def held_back(self, change: Array, material: Material) -> Array:
        """Each unknown by itself; between two points without a negative weight there is none."""
        most = LARGEST_SHARE * material.scattering_per_mm
        return np.clip(change, -most, most)

    def is_bound(self, x: Array) -> NDArray[np.bool_]:
        """Weights and absorption that are zero."""
        return x <= 0


def unit_atoms(values: Array) -> Array:
    """Phase functions (KNOTS, M) from values at the knots in any unit."""
    return np.asarray(values / (tent_solid_angles() @ values))
