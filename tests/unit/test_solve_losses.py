"""Losses as weights: each gives the derivative of the loss it stands for, on problems whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.records import Loss
from services.fit.solve.losses import CAUCHY, FLOOR, first_weights, is_reweighted, weights

LOSSES: tuple[Loss, ...] = ("l2", "relative_l2", "l1", "relative_l1", "robust")


def measured(seed: int = 1, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    reference = rng.uniform(0.0, 2.0, count)
    return reference, (0.01 * reference + 0.004) ** 2


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_positive_and_in_units_of_the_noise(loss: Loss) -> None:
    reference, variance = measured()
    residual = np.random.default_rng(2).standard_normal(len(reference)) * 0.1
    residual[:3] = 0.0, 1e-30, 50.0
    for found in (
        first_weights(loss, reference, variance),
        weights(loss, reference, variance, residual, 0.1 * variance),
    ):
        assert (found > 0).all()
        assert np.isfinite(found).all()
        assert found @ variance == pytest.approx(len(reference))


def test_noise_of_nothing_leaves_weights_of_mean_one() -> None:
    reference = np.array([1.0, 2.0])
    assert first_weights("relative_l2", reference, np.zeros(2)).mean() == pytest.approx(1.0)


def test_relative_loss_divides_by_the_reference() -> None:
    reference, variance = measured()
    found = first_weights("relative_l2", reference, variance)
    scaled = found * (reference + FLOOR * reference.mean()) ** 2
    np.testing.assert_allclose(scaled, scaled[0], rtol=1e-12)


def located(loss: Loss, values: np.ndarray, spread: float, rounds: int = 60) -> float:
    # A constant fitted to values by reweighting; a relative loss sees a reference of constant size.
    place, variance, level = float(values.mean()), np.full(len(values), spread**2), np.full(len(values), 5.0)
    for _ in range(rounds):
        found = weights(loss, level, variance, place - values, np.zeros(len(values)))
        place = float(found @ values / found.sum())
    return place


@pytest.mark.parametrize("loss", ["l1", "relative_l1"])
def test_l1_finds_the_median(loss: Loss) -> None:
    # An odd number of values; the remaining difference is from smoothing below a tenth of the given spread.
    values = np.random.default_rng(3).standard_exponential(101)
    assert located(loss, values, spread=0.01) == pytest.approx(np.median(values), abs=0.002)
    assert abs(values.mean() - np.median(values)) > 0.1


def test_robust_loss_ignores_a_shadow() -> None:
    # A fifth of the values is 20 standard deviations away: the mean moves by 4, Cauchy's estimate by less than 3
    # standard errors of the mean of the rest.
    rng = np.random.default_rng(4)
    values = rng.standard_normal(500)
    values[:100] -= 20.0
    assert abs(values.mean()) > 3.5
    assert abs(located("robust", values, spread=1.0)) < 3 / np.sqrt(400)


def test_robust_loss_is_as_good_as_least_squares_under_gaussian_noise() -> None:
    # The constant is chosen for an efficiency of 0.95; the variance ratio over 400 sets of 100 has an error of 7 %; 3
    # sigma.
    rng = np.random.default_rng(5)
    sets = rng.standard_normal((400, 100))
    ratio = np.var([located("robust", s, 1.0, rounds=8) for s in sets]) / np.var(sets.mean(axis=1))
    assert 0.95 < ratio * CAUCHY / 2.385 < 1.05 + 0.21


def test_only_losses_without_residuals_are_fixed() -> None:
    assert [loss for loss in LOSSES if is_reweighted(loss)] == ["l1", "relative_l1", "robust"]
