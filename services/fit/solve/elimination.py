"""Normal equations of the tissue alone, where the instrument's errors follow it.

Images are exactly linear in the errors e, and their columns B have no Monte Carlo noise. So for any tissue x the best
errors are known in closed form, and a step p of the tissue takes them along by -R p. What is left are equations of the
tissue (variable projection, Golub and Pereyra 1973):

    S = B'WB + P,   R = S^-1 B'WJ,   H = J'WJ - J'WB R,   g = J'Wr - R'(B'Wr + P e),

with P the precision of the errors' prior.

J'WB comes from noisy derivatives, so J'WB S^-1 B'WJ is too large by what its noise squares to, which its own covariance
tells and which is taken off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.curvature_noise import CurvatureNoise
from services.fit.solve.normal_equations import NormalEquations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LiftedNoise:
    """Noise of the curvature that is left: that of the whole along the directions in which errors follow the tissue."""

    whole: CurvatureNoise
    lift: Array

    def variance(self, directions: Array) -> Array:
        """Variance of u'Hu for each column u of ``directions`` (F, K)."""
        return self.whole.variance(self.lift @ directions)


@dataclass(frozen=True)
class Eliminated:
    """Equations of the tissue's coordinates (F,), and what the errors (K,) do meanwhile."""

    hessian: Array
    gradient: Array
    noise: CurvatureNoise | LiftedNoise
    gradient_noise: Array
    lift: Array
    """Step of all coordinates (F + K, F) by a step of the tissue."""
    settling: Array
    """Step of all coordinates (F + K,) that brings the errors to their best for the tissue as it is."""
    root: Array
    """S^-1/2, (K, K): one standard error of the errors where the tissue is known."""

    def eigenvalue_noise(self, directions: Array) -> Array:
        """Standard deviation of u'Hu for each column u of ``directions`` (F, K)."""
        return np.sqrt(self.noise.variance(directions))

    def step_noise(self, step: Array) -> float:
        """Standard deviation of the change g'p + p'Hp/2 that the model predicts for a step p."""
        curvature = float(self.noise.variance(step[:, None])[0])
        return float(np.sqrt(max(float(step @ self.gradient_noise @ step) + 0.25 * curvature, 0.0)))


def eliminate(equations: NormalEquations, precision: Array, slope: Array, count: int) -> Eliminated:
    """Leave the first ``count`` coordinates; without errors these are the equations themselves, the tissue's prior
    included.

    Args:
        precision: of the prior of all coordinates, (F + K, F + K).
        slope: of the prior's half square, (F + K,).
    """
    hessian, gradient = equations.hessian + precision, equations.gradient + slope
    size = len(gradient)
    if count == size:
        noises = equations.hessian_noise, equations.gradient_noise
        return Eliminated(hessian, gradient, *noises, np.eye(size), np.zeros(size), np.zeros((0, 0)))
    own, errors = slice(0, count), slice(count, size)
    values, vectors = np.linalg.eigh(hessian[errors, errors])
    root, inverse = (vectors * values**-0.5) @ vectors.T, (vectors / values) @ vectors.T
    follow = inverse @ hessian[errors, own]
    lift = np.concatenate([np.eye(count), -follow])
    left = hessian[own, own] - hessian[own, errors] @ follow + equations.hessian_noise.of_eliminated(inverse)
    settling = np.concatenate([np.zeros(count), -inverse @ gradient[errors]])
    return Eliminated(
        0.5 * (left + left.T),
        lift.T @ gradient,
        LiftedNoise(equations.hessian_noise, lift),
        lift.T @ equations.gradient_noise @ lift,
        lift,
        settling,
        root,
    )
