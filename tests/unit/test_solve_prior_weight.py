"""The prior of the instrument's errors against noisy renders: generalised least squares, by its own formula."""

from __future__ import annotations

import numpy as np
import pytest

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.coordinates.instrument_errors import InstrumentErrors
from services.fit.solve.covariance import uncertainty
from services.fit.solve.curvature_noise import CurvatureNoise
from services.fit.solve.elimination import eliminate, weighed
from services.fit.solve.normal_equations import NormalEquations

PRIOR = np.diag([0.01, 0.01, 0.003]) ** 2
NAMES = ("gain.red", "light_gain.l0", "flare.c0.red")
DOMAIN = Domain(
    (Coordinate(("enamel.sigma",)), Coordinate(("enamel.alpha",))),
    errors=InstrumentErrors(NAMES, tuple(map(tuple, PRIOR.tolist()))),
)
START = np.array([1.5, 2.5, 0.0, 0.0, 0.0])


def _equations(rendering: float, seed: int = 1) -> NormalEquations:
    # Equations of 60 measurements of unit noise, whose renders have ``rendering`` times the variance of that noise.
    random = np.random.default_rng(seed)
    slopes = random.standard_normal((60, 5)) * [30.0, 10.0, 100.0, 100.0, 100.0]
    hessian = slopes.T @ slopes
    residuals = np.sqrt(1 + rendering) * random.standard_normal(60)
    gradient = slopes.T @ residuals
    return NormalEquations(hessian, gradient, CurvatureNoise(()), rendering * hessian, hessian, 60.0, 60.0)


def _least_squares(equations: NormalEquations, rendering: float) -> tuple[np.ndarray, np.ndarray]:
    # Solution and covariance by generalised least squares: the measurements' whole noise, and the prior as it is.
    precision = np.zeros((5, 5))
    precision[2:, 2:] = np.linalg.inv(PRIOR)
    covariance = np.linalg.inv(equations.hessian / (1 + rendering) + precision)
    return START - covariance @ (equations.gradient / (1 + rendering)), covariance


@pytest.mark.parametrize("rendering", [0.0, 3.0, 500.0])
def test_solution_and_covariance_are_those_of_generalised_least_squares(rendering: float) -> None:
    equations = _equations(rendering)
    expected, covariance = _least_squares(equations, rendering)
    domain = weighed(DOMAIN, equations)
    assert domain.errors.weight == pytest.approx(1 + rendering)

    # The elimination's step, as the solver makes it.
    reduced = eliminate(equations, domain.precision, domain.prior_slope(START), 2)
    step = reduced.error_step + reduced.lift @ -np.linalg.solve(reduced.hessian, reduced.gradient)
    np.testing.assert_allclose(START + step, expected, rtol=1e-9, atol=1e-12)

    # Its standard errors. The prior is used already, so its second use moves nothing.
    known = uncertainty(domain, START + step, equations.moved(step))
    np.testing.assert_allclose(known.covariance, covariance, rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(known.x, expected, rtol=1e-6, atol=1e-9)


def test_without_the_weight_errors_follow_the_noise_of_renders() -> None:
    # What the weight prevents: errors several of their prior's standard errors away, by noise alone.
    far = []
    for seed in range(20):
        equations = _equations(500.0, seed)
        plain, given = (
            eliminate(equations, domain.precision, domain.prior_slope(START), 2)
            for domain in (DOMAIN, weighed(DOMAIN, equations))
        )
        far.append([abs(one.error_step[4] / 0.003) for one in (plain, given)])
    plain_median, weighed_median = np.median(far, axis=0)
    assert plain_median > 3.0
    assert weighed_median < 1.0


def test_a_fit_without_errors_of_the_instrument_stays_as_it_is() -> None:
    alone = Domain(DOMAIN.coordinates)
    assert weighed(alone, _equations(500.0)) is alone
