"""Reusing derivatives of earlier renders in a slab's normal equations, with images and derivatives whose noise is
known.
"""

from __future__ import annotations

import numpy as np
import pytest

from services.slab.cell.dictionary import KNOTS, Material, henyey_greenstein
from services.slab.cell.forward import Batches
from services.slab.solve.normal import (
    UNKNOWNS,
    DerivativeSums,
    NormalEquations,
    ResidualSums,
    normal_equations,
)
from services.slab.solve.weights import independent_weights

MATERIAL = henyey_greenstein(5.0, 0.5, 0.1)
IMAGES, PIXELS, COUNT = 2, 20, 6
SEEN = 3
"""Unknowns that the images depend on; derivatives by all others are zero."""
NOISE_OF_DERIVATIVES = 8.0
"""Noise of the derivatives in one batch. The derivatives are about one; noise of the mean over a render is three times
that."""
KEPT = 5 * COUNT
DRAWS, FEW_DRAWS = 50, 25

SIGNAL = np.random.default_rng(1).standard_normal((IMAGES, PIXELS, SEEN))
RESIDUAL = SIGNAL @ np.array([0.3, -0.2, 0.5]) + np.random.default_rng(2).standard_normal((IMAGES, PIXELS))
"""Residuals of images without noise of the paths: the distance still to go, and measurement noise of one."""
NO_SINGLE = np.zeros((IMAGES, PIXELS)), np.zeros((IMAGES, PIXELS, UNKNOWNS))


def noisy_rows(rng: np.random.Generator, count: int) -> np.ndarray:
    rows = np.zeros((count, IMAGES, PIXELS, UNKNOWNS))
    rows[..., :SEEN] = SIGNAL + NOISE_OF_DERIVATIVES * rng.standard_normal((count, IMAGES, PIXELS, SEEN))
    return rows


def equations(
    rng: np.random.Generator, earlier: DerivativeSums | None, near: ResidualSums | None = None
) -> NormalEquations:
    images = RESIDUAL + rng.standard_normal((COUNT, IMAGES, PIXELS))
    weights = independent_weights(np.ones((IMAGES, PIXELS)), np.zeros((IMAGES, PIXELS)))
    # Where path lengths are zero, sums of shares are the derivatives themselves.
    return normal_equations(
        Batches(images, noisy_rows(rng, COUNT), *NO_SINGLE),
        MATERIAL,
        np.zeros((IMAGES, PIXELS)),
        weights,
        earlier,
        near,
    )


def sums(rows: np.ndarray) -> DerivativeSums:
    """Derivative sums of batches (B, images, pixels, UNKNOWNS), with weights of one."""
    flat = rows.reshape(len(rows), IMAGES * PIXELS, UNKNOWNS)
    parts = flat[: len(rows) // 2], flat[len(rows) // 2 :]
    own = np.stack([np.einsum("bnu,bnv->uv", part[..., :SEEN], part[..., :SEEN]) for part in parts])
    spread = np.zeros((2, UNKNOWNS, UNKNOWNS))
    spread[:, :SEEN, :SEEN] = own
    return DerivativeSums(np.stack([part.sum(axis=0) for part in parts]), spread, (len(parts[0]), len(parts[1])))


def drawn(*, anew: bool, kept: bool = True) -> list[NormalEquations]:
    """Many draws of the normal equations.

    Args:
        anew: draw the earlier derivatives anew each time instead of using the same ones.
        kept: use earlier derivatives at all.
    """
    rng = np.random.default_rng(7)
    same = sums(noisy_rows(rng, KEPT))
    found = []
    for _ in range(DRAWS):
        earlier = (sums(noisy_rows(rng, KEPT)) if anew else same) if kept else None
        found.append(equations(rng, earlier))
    return found


def test_gradient_and_matrix_stay_without_bias() -> None:
    found = drawn(anew=True)
    for name, true in (
        ("gradient", np.einsum("ipu,ip->u", SIGNAL, RESIDUAL)),
        ("matrix", np.einsum("ipu,ipv->uv", SIGNAL, SIGNAL)),
    ):
        values = np.stack([getattr(one, name)[(slice(SEEN),) * true.ndim] for one in found])
        z = (values.mean(axis=0) - true) / (values.std(axis=0) / np.sqrt(DRAWS))
        assert np.abs(z).max() < 4


def test_the_gradients_noise_is_what_it_is_said_to_be() -> None:
    found = drawn(anew=False)
    spread = np.std([one.gradient[:SEEN] for one in found], axis=0)
    told = np.sqrt(np.mean([np.diag(one.gradient_noise)[:SEEN] for one in found], axis=0))
    # The spread of 50 draws is known to 10 %; terms of pairs, which the estimate omits, add a few per cent.
    np.testing.assert_allclose(told, spread, rtol=0.3)
    # Noise of the earlier derivatives combines with the measurements' noise in the same way in all batches.
    pooled = noisy_rows(np.random.default_rng(7), KEPT).sum(axis=0)[..., :SEEN] / (KEPT + COUNT) + SIGNAL * COUNT / (
        KEPT + COUNT
    )
    of_data = np.einsum("ipu,ipu->u", pooled, pooled)
    np.testing.assert_allclose(np.mean([np.diag(one.data_noise)[:SEEN] for one in found], axis=0), of_data, rtol=0.05)


@pytest.mark.slow
def test_earlier_derivatives_lower_the_noise_of_the_gradient() -> None:
    with_them, without = (
        np.std([one.gradient[:SEEN] for one in drawn(anew=True, kept=kept)], axis=0) for kept in (True, False)
    )
    # The squared noise of J is nine times the square of J and falls by KEPT / COUNT + 1 = 6; noise of the images
    # combines with the signal as before.
    assert (with_them < 0.6 * without).all()


def test_the_matrix_is_as_if_all_batches_were_of_one_render() -> None:
    rng = np.random.default_rng(5)
    kept = noisy_rows(rng, KEPT)
    later = np.random.default_rng(6)
    found = equations(np.random.default_rng(6), sums(kept))
    later.standard_normal((COUNT, IMAGES, PIXELS))
    every = np.concatenate([kept, noisy_rows(later, COUNT)]).reshape(KEPT + COUNT, -1, UNKNOWNS)[..., :SEEN]
    # The same sum, computed over pairs of different batches one pair at a time; the noise is the spread of single
    # batches.
    total, count = every.sum(axis=0), len(every)
    pairs = sum(one.T @ (total - one) for one in every) / (count * (count - 1))
    np.testing.assert_allclose(found.matrix[:SEEN, :SEEN], pairs, rtol=1e-9)
    apart = every - every.mean(axis=0)
    noise = np.einsum("bnu,bnv->uv", apart, apart) / (count * (count - 1))
    np.testing.assert_allclose(found.noise[:SEEN, :SEEN], noise, rtol=1e-6)


def test_none_are_as_no_earlier_render() -> None:
    rng = (np.random.default_rng(3), np.random.default_rng(3))
    nothing = sums(np.zeros((0, IMAGES, PIXELS, UNKNOWNS)))
    one, other = equations(rng[0], None), equations(rng[1], nothing)
    for name in ("gradient", "matrix", "gradient_noise", "noise", "noise_gradient", "matrix_error", "data_noise"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12, atol=1e-12)


def test_residuals_of_renders_before_join_without_bias_and_with_less_noise() -> None:
    rng = np.random.default_rng(8)
    found, alone = [], []
    for _ in range(FEW_DRAWS):
        first = equations(rng, None)
        found.append(equations(rng, first.derivatives, first.residuals))
        alone.append(first)
    assert found[0].residuals.count == 2 * COUNT
    true = np.einsum("ipu,ip->u", SIGNAL, RESIDUAL)
    joined, single = (np.stack([one.gradient[:SEEN] for one in each]) for each in (found, alone))
    assert np.abs((joined.mean(axis=0) - true) / (joined.std(axis=0) / np.sqrt(FEW_DRAWS))).max() < 4
    # Twice as many batches halve the variance, or do more where products of two kinds of noise matter; three of 25
    # draws are known to 20 %.
    assert joined.var(axis=0).sum() < 0.75 * single.var(axis=0).sum()


def test_the_gradient_is_that_at_the_mean_of_the_media_whose_residuals_join() -> None:
    nearer = Material(1.1 * MATERIAL.scattering, MATERIAL.absorption_per_mm)
    one = ResidualSums(np.ones(3), np.ones(UNKNOWNS), 4, unknowns(MATERIAL))
    both = one + ResidualSums(np.ones(3), np.ones(UNKNOWNS), 12, unknowns(nearer))
    assert both.count == 16
    np.testing.assert_allclose(
        both.place - unknowns(MATERIAL), np.append(np.full(KNOTS, 0.75 * np.log(1.1)), 0), atol=1e-12
    )
    np.testing.assert_array_equal(equations(np.random.default_rng(1), None).residuals.place, unknowns(MATERIAL))


def unknowns(material: Material) -> np.ndarray:
    return np.append(np.log(material.scattering), material.absorption_per_mm)
