"""What further images are predicted to add is what they add."""

from __future__ import annotations

import numpy as np

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.covariance import uncertainty
from services.fit.solve.information import AddedInformation, added_information, covariance_with
from services.fit.solve.normal_equations import NormalEquations, normal_equations

DOMAIN = Domain((Coordinate(("enamel.sigma",)), Coordinate(("enamel.alpha",), 2.3, 1.0), Coordinate(("dentin.sigma",))))
X = np.array([1.0, 2.3, 2.0])
NOISE = 0.05


def _equations(slopes: np.ndarray) -> NormalEquations:
    count = slopes.shape[1]
    zero = np.zeros(count)
    return normal_equations(slopes, slopes, zero, zero, np.full(count, NOISE**2), np.full(count, NOISE**-2))


def test_predicted_is_what_a_fit_with_both_states() -> None:
    rng = np.random.default_rng(1)
    first, second = 0.1 * rng.standard_normal((3, 40)), 0.1 * rng.standard_normal((3, 15))
    known = uncertainty(DOMAIN, X, _equations(first))
    assert known.sandwich is not None
    zero = np.zeros(15)
    added = added_information(known.sandwich, (second, second), (zero, zero), np.full(15, NOISE**2), NOISE**-2)
    both = uncertainty(DOMAIN, X, _equations(np.hstack([first, second])))
    np.testing.assert_allclose(covariance_with(known.sandwich, added), both.covariance, rtol=1e-9)
    np.testing.assert_allclose(covariance_with(known.sandwich, added.scaled(0.0)), known.covariance, rtol=1e-9)


def test_noise_that_looks_like_negative_information_is_none() -> None:
    known = uncertainty(DOMAIN, X, _equations(0.1 * np.random.default_rng(2).standard_normal((3, 40))))
    assert known.sandwich is not None
    nothing = AddedInformation(-0.5 * np.eye(3), np.zeros((3, 3)))
    np.testing.assert_allclose(covariance_with(known.sandwich, nothing), known.covariance, rtol=1e-9)


def test_a_new_light_of_unknown_gain_teaches_what_a_fit_with_that_gain_states() -> None:
    rng = np.random.default_rng(3)
    first, second, image = 0.1 * rng.standard_normal((3, 40)), 0.1 * rng.standard_normal((3, 15)), rng.uniform(1, 2, 15)
    known = uncertainty(DOMAIN, X, _equations(first))
    assert known.sandwich is not None
    zero, error = np.zeros(15), 0.03 * image[None]
    measured = (second, second), (zero, zero), np.full(15, NOISE**2), NOISE**-2
    found = covariance_with(known.sandwich, added_information(known.sandwich, *measured, error))
    # The same with the light's gain among the unknowns; its prior is 1, in units of its ±.
    rows = np.block([[first, second], [np.zeros((1, 40)), error]]) / NOISE
    whole = rows @ rows.T + np.diag([*DOMAIN.prior[1], 1.0])
    np.testing.assert_allclose(found, np.linalg.inv(whole)[:3, :3], rtol=1e-6)
    exact = covariance_with(known.sandwich, added_information(known.sandwich, *measured))
    assert (np.diag(found) > 1.01 * np.diag(exact)).any()
