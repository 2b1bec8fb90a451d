"""Normal equations whose derivatives follow smooth functions of the pixel: unbiased, errors true, and less noise."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from services.fit.measurements.smooth_functions import smooth_functions
from services.fit.solve.final_uncertainty import FinalSums, final_sums
from services.fit.solve.normal_equations import NormalEquations, normal_equations, smoothed, without_outliers

ROUNDS = 1000
EDGE, LIGHTS = 8, 3
NOISE_J, NOISE_R = 3.0, 0.5
"""Noise of one estimate of derivatives of size 1, and of one residual."""


@lru_cache(maxsize=1)
def _problem() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    # Derivatives (2, M) of which a part is rough, residuals, weights with masked pixels, and the functions.
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:EDGE, :EDGE].reshape(2, -1)
    functions = smooth_functions(np.stack([x, y], axis=1).astype(np.int32))
    smooth = 0.3 * rng.standard_normal((2, LIGHTS, len(functions))) @ functions
    rough = 0.1 * rng.standard_normal(smooth.shape)
    weight = rng.uniform(0.5, 2, (LIGHTS, EDGE**2)) * (rng.uniform(size=(LIGHTS, EDGE**2)) > 0.1)
    return (smooth + rough).reshape(2, -1), rng.standard_normal(weight.size), weight.reshape(-1), functions


def _noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    # Lights of a pixel share half of the variance, as those of one walk.
    shared = np.tile(rng.standard_normal((*shape, EDGE**2)), LIGHTS)
    return np.sqrt(0.5) * (shared + rng.standard_normal((*shape, LIGHTS * EDGE**2)))


def _draw(rng: np.random.Generator, functions: np.ndarray | None) -> NormalEquations:
    j, r, weight, _ = _problem()
    j1, j2 = (j + NOISE_J * _noise(rng, 2) for _ in range(2))
    r1, r2 = (r + NOISE_R * _noise(rng) for _ in range(2))
    return normal_equations(j1, j2, r1, r2, np.full(r.shape, 0.05), weight, LIGHTS, functions=functions)


@lru_cache(maxsize=2)
def _many(is_smooth: bool) -> tuple[NormalEquations, ...]:
    rng, functions = np.random.default_rng(1), _problem()[-1] if is_smooth else None
    return tuple(_draw(rng, functions) for _ in range(ROUNDS))


def test_sums_are_those_of_the_smooth_part_and_their_errors_true() -> None:
    j, r, weight, functions = _problem()
    part, many = smoothed(j, weight, LIGHTS, functions), _many(True)
    gradients, hessians, data = (
        np.array([getattr(one, name) for one in many]) for name in ("gradient", "hessian", "data_noise")
    )
    exact = (weight * part) @ r, (weight * part) @ part.T, (weight**2 * 0.05 * part) @ part.T
    for sample, truth in zip((gradients, hessians, data), exact, strict=True):
        z = (sample.mean(axis=0) - truth) / (sample.std(axis=0) / np.sqrt(ROUNDS))
        assert np.abs(z).max() < 4  # ten values: one failure in 1,500 runs

    # A variance of ROUNDS values has a relative error of sqrt(2 / ROUNDS), doubled for products of two normal values.
    tolerance = 4 * 2 * np.sqrt(2 / ROUNDS)
    for u in np.eye(2), np.linalg.qr(np.random.default_rng(2).standard_normal((2, 2)))[0]:
        seen = np.array([[direction @ h @ direction for direction in u.T] for h in hessians]).var(axis=0)
        stated = np.mean([one.eigenvalue_noise(u) ** 2 for one in many], axis=0)
        np.testing.assert_allclose(stated, seen, rtol=tolerance)
        np.testing.assert_allclose(
            np.mean([np.diag(u.T @ one.gradient_noise @ u) for one in many], axis=0),
            (gradients @ u).var(axis=0), rtol=tolerance,
        )  # fmt: skip


def test_they_have_less_noise_than_sums_pixel_by_pixel() -> None:
    # Ten functions of 58 valid pixels leave a sixth of the noise of the derivatives, which is most of the noise here.
    spread = [np.array([one.hessian for one in _many(is_smooth)]).std(axis=0).max() for is_smooth in (True, False)]
    assert spread[0] < 0.5 * spread[1]


def test_the_smooth_part_is_a_projection_orthogonal_under_the_weights() -> None:
    j, r, weight, functions = _problem()
    part = smoothed(j, weight, LIGHTS, functions)
    np.testing.assert_allclose(smoothed(part, weight, LIGHTS, functions), part, atol=1e-10)
    np.testing.assert_allclose((weight * part) @ r, (weight * j) @ smoothed(r[None], weight, LIGHTS, functions)[0])
    assert smoothed(j, weight, LIGHTS, None) is j


def test_fewer_valid_pixels_than_functions_leave_derivatives_as_they_are() -> None:
    j, _, weight, functions = _problem()
    few = np.where(np.arange(weight.size) % EDGE**2 < 4, weight, 0.0)
    assert np.isfinite(smoothed(j, np.zeros_like(weight), LIGHTS, functions)).all()
    seen = few > 0
    np.testing.assert_allclose(smoothed(j, few, LIGHTS, functions)[:, seen], j[:, seen], atol=1e-6)


@pytest.mark.parametrize("copied", [False, True])
def test_the_final_response_is_unbiased_and_its_error_true(copied: bool) -> None:
    j, r, weight, functions = _problem()
    rng, exact = np.random.default_rng(3), 0.8 * j

    def draw() -> FinalSums:
        similar = tuple(j + NOISE_J * _noise(rng, 2) for _ in range(2))
        true = tuple(exact + NOISE_J * _noise(rng, 2) for _ in range(2))
        residuals = tuple(r + NOISE_R * _noise(rng) for _ in range(2))
        moved = np.array([[0.1 * r + NOISE_R * _noise(rng) for _ in range(2)]])
        return final_sums(
            np.eye(2), (similar[0], similar[1]), (true[0], true[1]), np.array([copied, copied]),
            (residuals[0], residuals[1]), moved, weight, LIGHTS, functions=functions,
        )  # fmt: skip

    many = [draw() for _ in range(ROUNDS // 2)]
    part = smoothed(j, weight, LIGHTS, functions)
    truths = {
        "gradient": (weight * part) @ r,
        "response": (weight * part) @ (j if copied else exact).T,
        "shifts": ((weight * part) @ (0.1 * r))[None],
    }
    variances = {
        "gradient": np.mean([np.diag(one.gradient_noise) for one in many], axis=0),
        "response": np.mean([one.response_variance for one in many], axis=0),
        "shifts": np.mean([np.diag(one.shift_noise[0]) for one in many], axis=0)[None],
    }
    for name, truth in truths.items():
        sample = np.array([getattr(one, name) for one in many])
        z = (sample.mean(axis=0) - truth) / (sample.std(axis=0) / np.sqrt(len(many)))
        assert np.abs(z).max() < 4, name  # eight values
        tolerance = 4 * 2 * np.sqrt(2 / len(many))
        np.testing.assert_allclose(variances[name], sample.var(axis=0), rtol=tolerance, err_msg=name)


def test_rare_bright_paths_hardly_move_the_sums() -> None:
    # One derivative in fifty has 15 times the noise, which makes the variance 1 + 15**2 / 50 = 5.5 times the others'.
    # Here it is made four times smaller by clipping. Without, sums scatter 4.6 and 2.7 times as much as without rare
    # ones, and most state 1.3 and 1.6 times their scatter, because what they state is exact for normal noise.
    j, r, weight, functions = _problem()
    rng, flat = np.random.default_rng(9), np.full(weight.shape, 0.05)

    def spread(is_bright: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = []
        for _ in range(200):
            rare = np.where(is_bright & (rng.uniform(size=(2, *j.shape)) < 0.02), 15, 1)
            j1, j2 = (j + _noise(rng, 2) * factor for factor in rare)
            one = normal_equations(j1, j2, r, r, flat, weight, LIGHTS, functions=functions)
            found.append((np.diag(one.hessian), one.eigenvalue_noise(np.eye(2))))
        seen, stated = (np.array(part) for part in zip(*found, strict=True))
        return seen.mean(axis=0), seen.std(axis=0), np.median(stated, axis=0)

    (mean, seen, stated), (usual, usual_seen, _) = spread(True), spread(False)
    assert (seen < 2.5 * usual_seen).all()
    assert (stated < 1.6 * seen).all()
    np.testing.assert_allclose(mean, usual, rtol=0.1)


def test_rows_that_are_mostly_zero_are_not_clipped() -> None:
    j, _, weight, functions = _problem()
    few = np.where(np.arange(weight.size) % EDGE**2 < 9, j, 0.0)
    np.testing.assert_allclose(without_outliers(few, weight, LIGHTS, functions * 0), few)
    assert without_outliers(j, weight, LIGHTS, None) is j
