"""What a noisy normal matrix is believed of, and the two steps that are made with it: one of all unknowns, and one in broad directions.

Among two hundred unknowns that are mostly noise some direction always looks measured: eigenvalues of the noise alone reach far beyond
what any single direction's noise is. So a step of all unknowns is held by all of the noise. Ten broad directions, chosen before any
image, have only their own to fear. In a thick cell one of these is sigma_s at a constant sigma_s'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from services.fit.slab.solve.prior import RIDGE, Quadratic

Array = NDArray[np.float64]

MIN_SIGNAL = 0.1
"""Of the normal matrix, in units of the prior and of its own noise: directions below it count as not measured."""
HELD = 1.0
"""What holds a step in broad directions, in units of what the matrix may be off by there."""


@dataclass(frozen=True)
class Seen:
    """The directions that are believed: columns V (U, K) with V^T reference V = 1, and reference V."""

    vectors: Array
    dual: Array
    signals: Array
    prior: Array
    """With a ridge, so that it can be inverted."""

    @property
    def curvature(self) -> Array:
        """The normal matrix of these directions alone (U, U)."""
        return np.asarray((self.dual * self.signals) @ self.dual.T)

    @property
    def total(self) -> Array:
        """With the prior (U, U)."""
        return self.curvature + self.prior

    def projected(self, gradient: Array) -> Array:
        """A gradient's part in these directions (U,)."""
        return np.asarray(self.dual @ (self.vectors.T @ gradient))

    def noise(self, covariance: Array) -> Array:
        """That of a gradient's covariance (U, U); one estimated without bias may have slightly negative eigenvalues, a variance has none."""
        values, axes = np.linalg.eigh(self.vectors.T @ covariance @ self.vectors)
        half = self.dual @ axes * np.sqrt(np.maximum(values, 0))
        return np.asarray(half @ half.T)


def seen_of(quadratic: Quadratic, prior: Array) -> Seen:
    """Judge the normal matrix by its noise and a prior's precision (U, U)."""
    whole = prior + _ridge(quadratic)
    reference = whole + quadratic.noise
    signals, vectors = linalg.eigh(quadratic.matrix, reference)
    chosen = vectors[:, signals > MIN_SIGNAL]
    return Seen(chosen, reference @ chosen, signals[signals > MIN_SIGNAL], whole)


def step_matrix(quadratic: Quadratic, prior: Array, damping: float) -> Array:
    """What a step is solved with (U, U): ``damping`` times the noise of J holds what noise may have bent."""
    return np.asarray(quadratic.matrix + prior + damping * quadratic.noise + _ridge(quadratic))


def broad_step(quadratic: Quadratic, prior: Array, broad: Array, x: Array) -> Array:
    """A second step (U,) from x, along broad directions alone and not held by the noise of J.

    That noise adds up over all pixels, but the unbiased matrix is off by its fluctuation alone, which many pixels average. In a thick
    cell the direction of sigma_s at a constant sigma_s' has less signal than noise: held by all of it, steps went a tenth of their
    way there, and fits ended where their budget did. Both steps in turn are a cycle of two grids.
    """
    if not broad.size:
        return np.zeros(len(x))
    reference = prior + quadratic.noise + _ridge(quadratic)
    # Units in which each direction has unit noise, as ln f and an absorption differ.
    unit = broad / np.sqrt(np.einsum("ik,ij,jk->k", broad, reference, broad, optimize=True))
    own = unit.T @ reference @ unit
    chance = np.abs(linalg.eigh(unit.T @ quadratic.error @ unit, own, eigvals_only=True)).max()
    matrix = unit.T @ (quadratic.matrix + prior) @ unit + HELD * chance * own
    if np.linalg.eigvalsh(matrix)[0] <= 0:
        return np.zeros(len(x))
    slope = quadratic.linear + (quadratic.matrix + prior) @ x
    return np.asarray(unit @ np.linalg.solve(matrix, -(unit.T @ slope)))


def _ridge(quadratic: Quadratic) -> Array:
    size = len(quadratic.matrix)
    return np.asarray(RIDGE * float(np.abs(np.diag(quadratic.matrix)).max()) * np.eye(size))
