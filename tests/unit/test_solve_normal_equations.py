"""Normal equations from two seeds: the sums are unbiased, and the stated errors are the observed ones."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from services.fit.solve.normal_equations import NormalEquations, loss_change, normal_equations, pool

ROUNDS = 3000
MEASUREMENTS, LIGHTS = 160, 4


@lru_cache(maxsize=1)
def _many() -> tuple[NormalEquations, ...]:
    # Draws at which several tests look.
    return _noisy(np.random.default_rng(1), ROUNDS)


def _noisy(rng: np.random.Generator, count: int) -> tuple[NormalEquations, ...]:
    # Lights of a pixel share half of the variance of their noise, like lights of one walk.
    j, r, weight = _problem()
    reference = np.full(MEASUREMENTS, 0.05)

    def noise(*shape: int) -> np.ndarray:
        shared = np.tile(rng.standard_normal((*shape, MEASUREMENTS // LIGHTS)), LIGHTS)
        return np.sqrt(0.5) * (shared + rng.standard_normal((*shape, MEASUREMENTS)))

    def draw() -> NormalEquations:
        j1, j2 = (j + 0.8 * noise(3) for _ in range(2))
        r1, r2 = (r + np.sqrt(0.6) * noise() for _ in range(2))
        return normal_equations(j1, j2, r1, r2, reference, weight, LIGHTS)

    return tuple(draw() for _ in range(count))


def _problem() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.standard_normal((3, MEASUREMENTS)), rng.standard_normal(MEASUREMENTS), rng.uniform(0.5, 2, MEASUREMENTS)


def test_sums_are_unbiased_and_their_errors_true() -> None:
    j, r, weight = _problem()
    many = _many()
    gradients = np.array([e.gradient for e in many])
    hessians = np.array([e.hessian for e in many])

    # Means compared with the sums without noise: for 12 values, a family-wise error of 1e-3 is |z| < 4.
    for sample, exact in ((gradients, (weight * j) @ r), (hessians, (weight * j) @ j.T)):
        z = (sample.mean(axis=0) - exact) / (sample.std(axis=0) / np.sqrt(ROUNDS))
        assert np.abs(z).max() < 4

    # Stated compared with observed variances: a variance of ROUNDS values has a relative error of sqrt(2 / ROUNDS) =
    # 2.6 %, doubled for non-Gaussian products; 4 sigma.
    tolerance = 4 * 2 * np.sqrt(2 / ROUNDS)
    for u in np.eye(3), np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]:
        seen = np.array([[direction @ h @ direction for direction in u.T] for h in hessians]).var(axis=0)
        stated = np.mean([e.eigenvalue_noise(u) ** 2 for e in many], axis=0)
        np.testing.assert_allclose(stated, seen, rtol=tolerance)
        np.testing.assert_allclose(
            np.mean([np.diag(u.T @ e.gradient_noise @ u) for e in many], axis=0), ((gradients @ u).var(axis=0)),
            rtol=tolerance
        )  # fmt: skip


def test_data_noise_is_unbiased() -> None:
    j, _, weight = _problem()
    many = _many()
    sample = np.array([e.data_noise for e in many])
    exact = (weight**2 * 0.05 * j) @ j.T
    z = (sample.mean(axis=0) - exact) / (sample.std(axis=0) / np.sqrt(ROUNDS))
    assert np.abs(z).max() < 4


@pytest.mark.parametrize("edge", [1, 8])
def test_compared_losses_are_unbiased_and_their_error_true(edge: int) -> None:
    # In cells of ``edge`` pixels the loss is that of their mean residuals, which are made equal to the truth.
    rng = np.random.default_rng(7)
    cell = (np.arange(MEASUREMENTS // LIGHTS) // edge).astype(np.int32)
    old, new = (rng.standard_normal((LIGHTS, cell[-1] + 1))[:, cell].reshape(-1) for _ in range(2))
    weight = rng.uniform(0.5, 2, MEASUREMENTS)
    changes = []
    for _ in range(ROUNDS):
        shared = np.tile(rng.standard_normal((2, MEASUREMENTS // LIGHTS)), LIGHTS)
        own = rng.standard_normal((2, 2, MEASUREMENTS))
        o = [old + 0.5 * shared[k] + 0.1 * own[0, k] for k in range(2)]
        n = [new + 0.5 * shared[k] + 0.1 * own[1, k] for k in range(2)]
        changes.append(loss_change(o[0], o[1], n[0], n[1], weight, LIGHTS, None if edge == 1 else cell))
    values = np.array([c.change for c in changes])
    exact = 0.5 * float(weight @ (new**2 - old**2))
    assert abs(values.mean() - exact) < 4 * values.std() / np.sqrt(ROUNDS)
    np.testing.assert_allclose(np.mean([c.variance for c in changes]), values.var(), rtol=8 * np.sqrt(2 / ROUNDS))


def test_cells_take_away_noise_and_leave_what_is_smooth() -> None:
    # 16 pixels in a cell: noise that is larger than the residuals falls with the root, to a quarter. Within a cell, the
    # difference between old and new is the same for every pixel.
    rng, pixels = np.random.default_rng(8), 640
    cell = (np.arange(pixels) // 16).astype(np.int32)
    old, weight = 0.1 * rng.standard_normal(40)[cell], np.ones(pixels)
    new = old + 0.05
    (o1, o2), (n1, n2) = old + rng.standard_normal((2, pixels)), new + rng.standard_normal((2, pixels))
    alone, together = (loss_change(o1, o2, n1, n2, weight, 1, cells) for cells in (None, cell))
    exact = loss_change(old, old, new, new, weight, 1)
    np.testing.assert_allclose(loss_change(old, old, new, new, weight, 1, cell).change, exact.change)
    # Both errors are estimates from 40 cells, good to 20 %; they should differ by a factor of 4, and 2 is required.
    assert together.se < 0.5 * alone.se
    assert abs(together.change - exact.change) < 4 * together.se


def test_a_cell_without_weight_counts_for_nothing() -> None:
    rng, cell = np.random.default_rng(9), np.array([0, 0, 2, 2], dtype=np.int32)
    (o1, o2, n1, n2), weight = rng.standard_normal((4, 4)), np.array([1.0, 2.0, 0.0, 0.0])
    found = loss_change(o1, o2, n1, n2, weight, 1, cell)
    assert found == loss_change(o1[:2], o2[:2], n1[:2], n2[:2], weight[:2], 1, cell[:2])


def test_pooling_averages_monte_carlo_noise_but_not_the_data() -> None:
    first, second = _noisy(np.random.default_rng(9), 2)
    both = pool(first, 64, second, 64)
    np.testing.assert_allclose(both.gradient, 0.5 * (first.gradient + second.gradient))
    np.testing.assert_allclose(both.gradient_noise, 0.25 * (first.gradient_noise + second.gradient_noise))
    np.testing.assert_allclose(both.data_noise, 0.5 * (first.data_noise + second.data_noise))


def test_moving_the_model_keeps_its_predictions() -> None:
    (equations,) = _noisy(np.random.default_rng(11), 1)
    step, further = np.array([0.3, -0.2, 0.1]), np.array([-0.1, 0.4, 0.2])
    moved = equations.moved(step)

    def model(e: NormalEquations, p: np.ndarray) -> float:
        return float(e.gradient @ p + 0.5 * p @ e.hessian @ p)

    assert np.isclose(model(equations, step + further), model(equations, step) + model(moved, further))
    assert NormalEquations.of(equations.record()).record() == equations.record()
