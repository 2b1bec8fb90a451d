"""Weights of a slab's images: cameras of one light share noise of the paths, and shared noise is not counted as
independent.
"""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.solve.weights import independent_weights, smoothed_covariance, weights_of

SHAPE = (2, 3)
GROUPS = (np.array([0, 2]), np.array([1, 3]))


def noise(seed: int) -> list[np.ndarray]:
    # Covariances (pixels, 2, 2) for each of two lights: nine tenths of the variance are shared by both cameras.
    rng = np.random.default_rng(seed)
    alike = rng.uniform(1, 2, (2, 6, 1, 1))
    return [one * np.array([[1.0, 0.9], [0.9, 1.0]]) for one in alike]


def test_whitened_values_have_the_inverse_of_their_covariance_for_a_weight() -> None:
    variances, covariances = np.random.default_rng(1).uniform(0.1, 0.3, (4, 6)), noise(2)
    weights = weights_of(GROUPS, variances, covariances)
    values = np.random.default_rng(3).standard_normal((4, 6))
    whitened = weights.whitened(values[None])[0]
    scattered = weights.of_measurements(whitened[None])[0]
    total, of_measurements = 0.0, 0.0
    for own, covariance in zip(GROUPS, covariances, strict=True):
        for pixel in range(6):
            inverse = np.linalg.inv(covariance[pixel] + np.diag(variances[own, pixel]))
            y = values[own, pixel]
            total += y @ inverse @ y
            of_measurements += y @ inverse @ np.diag(variances[own, pixel]) @ inverse @ y
    assert float((whitened**2).sum()) == pytest.approx(total)
    assert float((scattered**2).sum()) == pytest.approx(of_measurements)


def test_derivatives_are_whitened_as_images_are() -> None:
    weights = weights_of(GROUPS, np.full((4, 6), 0.2), noise(4))
    rows = np.random.default_rng(5).standard_normal((1, 4, 6, 3))
    expected = np.stack([weights.whitened(rows[..., k]) for k in range(3)], axis=-1)
    np.testing.assert_allclose(weights.whitened(rows), expected)


def test_a_value_without_a_variance_weighs_nothing_and_takes_nothing_from_the_others() -> None:
    variances = np.full((4, 6), 0.2)
    variances[2, 4] = np.inf
    weights = weights_of(GROUPS, variances, noise(6))
    assert int(weights.used.sum()) == 23
    whitened = weights.whitened(np.ones((1, 4, 6)))[0]
    assert whitened[2, 4] == 0
    # The other camera's value there is weighted as if alone.
    assert whitened[0, 4] ** 2 == pytest.approx(1 / (0.2 + noise(6)[0][4, 0, 0]))


def test_independent_weights_are_inverse_variances() -> None:
    variances, own = np.random.default_rng(7).uniform(0.1, 0.3, (2, 4, 6))
    whitened = independent_weights(variances, own).whitened(np.ones((1, 4, 6)))[0]
    np.testing.assert_allclose(whitened**2, 1 / (variances + own))


def test_the_covariance_of_batches_is_that_of_their_mean() -> None:
    # 4,000 batches of noise, half of it shared by two cameras. A corner's mean weights pixels by 4, 2, 2 and 1 ninths,
    # like 3.2 equal ones: a variance of 13,000 draws is known to 1.2 %, and 5 % is four times that.
    rng = np.random.default_rng(8)
    shared = rng.standard_normal((4000, 1, 6))
    images = np.sqrt(0.5) * (shared + rng.standard_normal((4000, 2, 6)))
    found = smoothed_covariance(images, SHAPE)
    assert found.shape == (6, 2, 2)
    np.testing.assert_allclose(4000 * found, np.broadcast_to([[1.0, 0.5], [0.5, 1.0]], found.shape), atol=0.05)
