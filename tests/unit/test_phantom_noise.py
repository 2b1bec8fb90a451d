"""The variance of a phantom's images that few bright paths make noisy."""

from __future__ import annotations

import numpy as np

from services.phantom.render import variance_of_neighbours

BATCHES = 16


def test_images_weighed_by_their_neighbours_variance_are_not_too_dark() -> None:
    # Pixels of mean 1 from 16 batches of a lognormal of skewness 33, as of few bright paths: 32 % noise in each.
    random = np.random.default_rng(3)
    batches = np.exp(1.12 * random.standard_normal((BATCHES, 8, 40, 40)) - 0.5 * 1.12**2)
    image, variance = batches.mean(axis=0), batches.var(axis=0, ddof=1) / BATCHES

    def weighed(variance: np.ndarray) -> float:
        return float((image / variance).sum() / (1 / variance).sum())

    # 12,800 pixels leave the mean uncertain by 0.3 %, and the weights' own spread makes that 1 % at most.
    assert weighed(variance) < 0.8
    assert abs(weighed(variance_of_neighbours(variance)) - 1) < 0.03


def test_pixels_without_light_keep_their_variance_and_give_none() -> None:
    variance = np.zeros((1, 7, 7))
    variance[0, 3, 2:5] = 1.0, 2.0, 4.0
    variance[0, 0, 0] = 8.0
    found = variance_of_neighbours(variance)
    np.testing.assert_array_equal(found[0, 3, 2:5], [3.0, 2.5, 1.5])
    assert found[0, 0, 0] == 8.0  # no neighbour has any
    assert np.count_nonzero(found) == 4
