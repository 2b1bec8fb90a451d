"""Noise of a curvature in parts: for directions and products it gives the same as the whole covariance."""

from __future__ import annotations

import json

import numpy as np

from services.fit.solve.curvature_noise import CurvatureNoise, curvature_noise
from services.fit.solve.normal_equations import NormalEquations, normal_equations

COUNT, MEASUREMENTS = 5, 60


def whole_covariance(mean: np.ndarray, difference: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Covariance (F*F, F*F) of all entries, from its definition."""
    products = 0.5 * (mean[:, None] * difference[None] + difference[:, None] * mean[None]) * weight
    flat = products.reshape(-1, products.shape[-1])
    return flat @ flat.T


def random_estimates(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return (
        rng.standard_normal((COUNT, MEASUREMENTS)),
        rng.standard_normal((COUNT, MEASUREMENTS)),
        rng.uniform(0.5, 2, MEASUREMENTS),
    )


def test_one_part_is_the_whole() -> None:
    mean, difference, weight = random_estimates(1)
    whole, noise = (
        whole_covariance(mean, difference, weight),
        CurvatureNoise((curvature_noise(mean, difference, weight, range(COUNT)),)),
    )
    directions = np.random.default_rng(2).standard_normal((COUNT, 7))
    pairs = np.einsum("ak,bk->kab", directions, directions).reshape(7, -1)
    np.testing.assert_allclose(noise.variance(directions), np.einsum("ka,ab,kb->k", pairs, whole, pairs), rtol=1e-12)
    vector = directions[:, 0]
    expected = np.einsum("aibj,i,j->ab", whole.reshape((COUNT,) * 4), vector, vector)
    np.testing.assert_allclose(noise.of_product(vector), expected, rtol=1e-11, atol=1e-12 * np.abs(expected).max())


def test_parts_of_measurements_that_know_few_coordinates_add_up_to_the_whole() -> None:
    mean, difference, weight = random_estimates(3)
    left = np.arange(MEASUREMENTS) < MEASUREMENTS // 2
    for array in (mean, difference):
        array[3:, left] = 0.0
        array[:2, ~left] = 0.0
    parts = CurvatureNoise((curvature_noise(mean[:, left], difference[:, left], weight[left], (0, 1, 2)),))
    parts = parts + CurvatureNoise((curvature_noise(mean[:, ~left], difference[:, ~left], weight[~left], (2, 3, 4)),))
    whole = CurvatureNoise((curvature_noise(mean, difference, weight, range(COUNT)),))
    directions = np.random.default_rng(4).standard_normal((COUNT, 7))
    np.testing.assert_allclose(parts.variance(directions), whole.variance(directions), rtol=1e-12)
    np.testing.assert_allclose(
        parts.of_product(directions[:, 0]), whole.of_product(directions[:, 0]), rtol=1e-11, atol=1e-12
    )
    # A second block with the same coordinates is added to the existing part.
    assert len((parts + parts).parts) == 2
    np.testing.assert_allclose((parts + parts).variance(directions), parts.scaled(2.0).variance(directions), rtol=1e-12)


def test_a_record_holds_the_same_numbers() -> None:
    mean, difference, weight = random_estimates(5)
    regions = [((0, 1, 2), np.arange(MEASUREMENTS) < 20), ((2, 3, 4), np.arange(MEASUREMENTS) >= 20)]
    residual, ones = np.zeros(MEASUREMENTS), np.ones(MEASUREMENTS)
    equations = normal_equations(
        mean + difference / 2, mean - difference / 2, residual, residual, ones, weight, 1, regions
    )
    stored = NormalEquations.of(json.loads(json.dumps(equations.record())))
    assert [part.coordinates for part in stored.hessian_noise.parts] == [(0, 1, 2), (2, 3, 4)]
    for one, other in zip(stored.hessian_noise.parts, equations.hessian_noise.parts, strict=True):
        np.testing.assert_array_equal(one.moments, other.moments)
    np.testing.assert_array_equal(stored.hessian, equations.hessian)
