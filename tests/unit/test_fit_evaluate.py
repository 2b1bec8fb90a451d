"""The image error, with the noise of photographs and of renders removed."""

from __future__ import annotations

import numpy as np
import pytest

from services.fit.passes.evaluate import ErrorSums, error_sums


@pytest.mark.parametrize("truth_error", [0.0, 0.05, 0.2])
def test_error_is_unbiased_by_either_noise(truth_error: float) -> None:
    # Squared error over 400 draws, z < 4 (two-sided 6e-5 each).
    rng, size = np.random.default_rng(int(100 * truth_error)), 500
    reference = rng.uniform(0.5, 1.5, size)
    model = reference * (1 + truth_error * rng.choice([-1, 1], size))
    exact = float(((model - reference) ** 2).sum() / (reference**2).sum())
    squares = []
    for _ in range(400):
        variance = np.full(size, 0.1**2)
        noisy = reference + 0.1 * rng.standard_normal(size)
        first, second = (model + 0.3 * rng.standard_normal(size) for _ in range(2))
        sums = error_sums(first, second, noisy, variance, np.ones(size, dtype=bool))
        squares.append((sums.product - sums.reference_variance) / (sums.reference_squared - sums.reference_variance))
    z = (np.mean(squares) - exact) / (np.std(squares) / np.sqrt(len(squares)))
    assert abs(z) < 4


def test_lights_of_a_pixel_err_together() -> None:
    # Twelve lights with the very same noise. A variance over 2000 draws is known to 3 %, or to three times that with
    # heavy tails.
    rng, reference = np.random.default_rng(3), np.full((12, 60), 1.0)
    draws = []
    for _ in range(2000):
        first, second = (reference * 1.1 + 0.2 * rng.standard_normal(60) for _ in range(2))
        draws.append(
            error_sums(first, second, reference, np.zeros_like(reference), np.ones_like(reference, dtype=bool))
        )
    stated, seen = np.mean([draw.product_noise for draw in draws]), np.var([draw.product for draw in draws])
    assert stated == pytest.approx(seen, rel=0.1)


def test_masked_measurements_do_not_count_and_blocks_add() -> None:
    rng = np.random.default_rng(5)
    a, b, r = rng.uniform(0.5, 1.5, (3, 40))
    v, chosen = np.full(40, 1e-4), rng.uniform(size=40) > 0.3
    a[~chosen] = np.nan
    whole = error_sums(a, b, r, v, chosen)
    parts = error_sums(a[:15], b[:15], r[:15], v[:15], chosen[:15]) + error_sums(
        a[15:], b[15:], r[15:], v[15:], chosen[15:]
    )
    assert whole.error == pytest.approx(parts.error)
    assert np.isfinite(whole.error or np.nan)


def test_no_signal_has_no_error() -> None:
    assert ErrorSums().error is None
    assert ErrorSums(1.0, 1.0, 2.0).error is None
    assert ErrorSums(-1.0, 1.0, 0.0).error == 0.0


def test_errors_of_a_step_stop_at_what_its_samples_resolve() -> None:
    noisy = ErrorSums(-0.01, 1.0, 0.0, 0.02**2)
    assert noisy.loss == pytest.approx(0.02)
    assert noisy.resolved_error == pytest.approx(np.sqrt(0.02))
    clear = ErrorSums(0.25, 1.0, 0.0, 0.02**2)
    assert clear.resolved_error == clear.error == 0.5
