"""Normal equations of the tissue's parameters, with the instrument's calibration errors eliminated.

Images are exactly linear in the errors e, and the columns B of their derivatives have no Monte Carlo noise. So for any
tissue parameters x the optimal errors are known in closed form, and a step p of the tissue changes them by -R p. The
reduced equations of the tissue are (variable projection, Golub and Pereyra 1973; a Schur complement):

    S = B'WB + P,   R = S^-1 B'WJ,   H = J'WJ - J'WB R,   g = J'Wr - R'(B'Wr + P e),

with P the precision of the errors' prior.

A fit weighs photographs by their own noise, and with few paths renders have far more: 400 to 1,500 times that variance
in fits of a small tooth. Minimised with such weights, F lets the errors follow the renders' noise, by several standard
errors of their prior. Generalised least squares divides the data's part of F by the factor by which all noise exceeds
the photographs' own: up to a constant, it multiplies P by that factor, which is about the same for all errors
(``weighed``).

J'WB comes from noisy derivatives, so J'WB S^-1 B'WJ is on average too large by the mean square of that noise. The
covariance of J'WB gives this bias, and it is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain
from services.fit.solve.curvature_noise import CurvatureNoise
from services.fit.solve.normal_equations import NormalEquations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LiftedNoise:
    """Noise of the reduced curvature: the noise of the whole curvature, along directions in which the errors follow the
    tissue.
    """

    whole: CurvatureNoise
    lift: Array

    def variance(self, directions: Array) -> Array:
        """Variance of u'Hu for each column u of ``directions`` (F, K)."""
        return self.whole.variance(self.lift @ directions)


@dataclass(frozen=True)
class ReducedEquations:
    """Reduced normal equations of the tissue's coordinates (F,), and the dependence of the K instrument errors
    on them.
    """

    hessian: Array
    gradient: Array
    noise: CurvatureNoise | LiftedNoise
    gradient_noise: Array
    lift: Array
    """Matrix (F + K, F) that turns a step of the tissue into the step of all coordinates."""
    error_step: Array
    """Step (F + K,) of all coordinates that brings the errors to their optimum and leaves the tissue as it is."""
    root: Array
    """S^-1/2 (K, K), the square root of the errors' covariance where the tissue is known exactly."""
    error_noise: Array
    """Monte Carlo covariance (K, K) of the errors' step."""

    def eigenvalue_noise(self, directions: Array) -> Array:
        """Standard deviation of u'Hu for each column u of ``directions`` (F, K)."""
        return np.sqrt(self.noise.variance(directions))

    def step_noise(self, step: Array) -> float:
        """Standard deviation of the change g'p + p'Hp/2 that the model predicts for a step p."""
        curvature = float(self.noise.variance(step[:, None])[0])
        return float(np.sqrt(max(float(step @ self.gradient_noise @ step) + 0.25 * curvature, 0.0)))


def eliminate(equations: NormalEquations, precision: Array, slope: Array, count: int) -> ReducedEquations:
    """Eliminate all but the first ``count`` coordinates.

    Without instrument errors the result is the equations themselves, with the tissue's prior added.

    Args:
        precision: precision matrix of the prior of all coordinates, (F + K, F + K).
        slope: gradient (F + K,) of the prior's term of the objective, half its square.
        count: number F of the tissue's coordinates, which come first.
    """
    hessian, gradient = equations.hessian + precision, equations.gradient + slope
    size = len(gradient)
    if count == size:
        noises = equations.hessian_noise, equations.gradient_noise
        none = np.zeros((0, 0))
        return ReducedEquations(hessian, gradient, *noises, np.eye(size), np.zeros(size), none, none)
    own, errors = slice(0, count), slice(count, size)
    values, vectors = np.linalg.eigh(hessian[errors, errors])
    root, inverse = (vectors * values**-0.5) @ vectors.T, (vectors / values) @ vectors.T
    error_response = inverse @ hessian[errors, own]
    lift = np.concatenate([np.eye(count), -error_response])
    reduced = (
        hessian[own, own]
        - hessian[own, errors] @ error_response
        + equations.hessian_noise.of_eliminated(inverse, count)
    )
    error_step = np.concatenate([np.zeros(count), -inverse @ gradient[errors]])
    return ReducedEquations(
        0.5 * (reduced + reduced.T),
        lift.T @ gradient,
        LiftedNoise(equations.hessian_noise, lift),
        lift.T @ equations.gradient_noise @ lift,
        lift,
        error_step,
        root,
        inverse @ equations.gradient_noise[errors, errors] @ inverse,
    )


def weighed(domain: Domain, equations: NormalEquations) -> Domain:
    """The domain whose prior of the instrument's errors counts as the noise in these equations requires: 1 plus the
    median ratio of the gradient's variance by rendering to that by the photographs' noise, over the errors.
    """
    if not domain.errors.names:
        return domain
    by_rendering, by_photographs = (
        np.diag(noise)[domain.tissue_count :] for noise in (equations.gradient_noise, equations.data_noise)
    )
    # An error that changes no photograph has no noise to compare.
    told = by_photographs > 0
    ratio = float(np.median(by_rendering[told] / by_photographs[told])) if told.any() else 0.0
    return replace(domain, errors=replace(domain.errors, weight=1 + max(ratio, 0.0)))
