"""Smoothness of ln f: its second derivative by angle is Gaussian, with a scale that the evidence chooses.

A phase function is even at both poles, so the second difference there takes the mirrored neighbour: it pulls the slope to
zero where no camera looks. The prior is not centred on an HG function, which would put a forward peak where none is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.slab.model.dictionary import KNOTS, SPACING_RAD
from services.fit.slab.solve.normal import UNKNOWNS

Array = NDArray[np.float64]

THIN_SCALES = (3.0, 10.0, 30.0)
"""Standard deviations of d2 ln f / d theta2, per rad2, among which the evidence chooses; HG 0.8 has 60 at its peak, 3 beyond 20 degrees."""
THICK_SCALES = (1.0, 3.0)
"""The same where sigma_t w exceeds ``THICK``: there only few and smooth features are seen."""
RIDGE = 1e-12
"""Of the largest curvature, so that a direction that nothing tells of can be solved for."""
THICK = 4.0


def second_differences() -> Array:
    """Matrix (KNOTS, KNOTS) from ln f to its second derivative, per rad2."""
    matrix = np.zeros((KNOTS, KNOTS))
    rows = np.arange(1, KNOTS - 1)
    matrix[rows, rows - 1] = matrix[rows, rows + 1] = 1
    matrix[0, 1] = matrix[-1, -2] = 2
    np.fill_diagonal(matrix, -2)
    return matrix / SPACING_RAD**2


def precision(scale: float | Array) -> Array:
    """Inverse covariance of all unknowns (UNKNOWNS, UNKNOWNS) for one scale or one per knot; nothing is assumed of the absorption."""
    bends = second_differences() / np.broadcast_to(scale, KNOTS)[:, None]
    matrix = np.zeros((UNKNOWNS, UNKNOWNS))
    matrix[:KNOTS, :KNOTS] = bends.T @ bends
    return matrix


def scales_for(thickness: float) -> tuple[float, ...]:
    """Candidates at an optical thickness sigma_t w."""
    return THICK_SCALES if thickness > THICK else THIN_SCALES


@dataclass(frozen=True)
class Quadratic:
    """Half the misfit near a material: linear^T x + x^T matrix x / 2 + a constant, in the unknowns x and not in steps."""

    matrix: Array
    linear: Array
    noise: Array
    """What the Monte Carlo noise of the derivatives would add to the matrix, positive semidefinite."""
    noise_linear: Array
    """And to the linear term."""

    def minimum(self, prior: Array, around: Array, damping: float) -> Array:
        """The minimum with a prior, absorption not below zero.

        The Levenberg term is ``damping`` times the noise about ``around``: what noise may have bent is held there. It moves
        no fixed point, so that repeated steps from fresh paths end where an undamped one would.
        """
        held = damping * self.noise + RIDGE * float(np.abs(np.diag(self.matrix)).max()) * np.eye(UNKNOWNS)
        return _bounded(self.matrix + prior + held, held @ around - self.linear)

    def log_evidence(self, scale: float) -> float:
        """Of the prior's scale, but for a constant that all scales share.

        The mean derivatives are taken as if they were exact: the matrix is then positive, and a scale cannot win by following
        directions of negative curvature, which the unbiased matrix has.
        """
        prior = precision(scale)
        linear, total = self.linear + self.noise_linear, self.matrix + self.noise + prior
        x = _bounded(total + RIDGE * float(np.diag(total).max()) * np.eye(UNKNOWNS), -linear)
        sign, log_determinant = np.linalg.slogdet(total)
        return (
            float(-(linear @ x + 0.5 * x @ total @ x) - 0.5 * log_determinant - (KNOTS - 1) * np.log(scale))
            if sign > 0
            else -np.inf
        )


def _bounded(matrix: Array, right: Array) -> Array:
    """Solve for all unknowns; where the absorption comes out negative, for the others with none."""
    x = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    if x[-1] < 0:
        x = np.append(np.asarray(np.linalg.solve(matrix[:-1, :-1], right[:-1]), dtype=np.float64), 0.0)
    return x
