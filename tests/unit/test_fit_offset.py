"""The registration check: its two error rates and its ±, on shaded balls whose noise is drawn many times.

``python -m tests.benchmarks.registration`` measures the rates on rendered teeth.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.fit.checks.alignment import reported_offset
from services.fit.checks.offset import Comparison, FoundOffset, ShiftedRender, best_offset

Array = NDArray[np.float64]
SIZE, PIXEL_MM, RADIUS_PX = 40, 0.5, 9.0


def ball(rng: np.random.Generator, offset_px: tuple[float, float] = (0.0, 0.0)) -> tuple[Array, Array]:
    """A shaded ball before black: the render, and a photograph in which the ball is moved by ``offset_px``."""
    light, exponent = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.7, 1.3)

    def image(right: float, down: float) -> Array:
        y, x = np.mgrid[:SIZE, :SIZE] + 0.5
        u, v = (x - SIZE / 2 - right) / RADIUS_PX, (y - SIZE / 2 - down) / RADIUS_PX
        depth = np.sqrt(np.maximum(1 - u**2 - v**2, 0))
        shading = np.maximum(0.8 * depth + light[0] * u + light[1] * v, 0) ** exponent
        return np.where(u**2 + v**2 < 1, 0.2 + shading, 0.0)

    return image(0, 0), image(*offset_px)


def compared(
    render: Array,
    photo: Array,
    noise: float,
    rng: np.random.Generator,
    stated: float | None = None,
    spread: float = 0.0,
) -> Comparison:
    """A photograph with constant noise, compared with a render that has its own noise."""
    seen = render > 0
    noisy = np.where(seen, render + spread * rng.standard_normal(render.shape), np.nan)
    known = np.abs(spread * rng.standard_normal(render.shape))  # as from two renders: with one degree of freedom
    variance = np.full(photo.shape, (noise if stated is None else stated) ** 2)
    return Comparison(photo + noise * rng.standard_normal(photo.shape), variance, noisy, known)


def pixels(render: Array) -> NDArray[np.int64]:
    """The pixels of the ball."""
    return np.argwhere(render > 0)[:, ::-1].astype(np.int64)


def draws(count: int, offset_px: tuple[float, float], noise: float, spread: float = 0.0) -> list[FoundOffset]:
    """Offsets found in this many draws of noise on one ball."""
    render, photo = ball(np.random.default_rng(1), offset_px)
    rngs = [np.random.default_rng([2, k]) for k in range(count)]
    images = [compared(render, photo, noise, rng, spread=spread) for rng in rngs]
    found = [best_offset(ShiftedRender([image], pixels(render)), PIXEL_MM) for image in images]
    return [one for one in found if one is not None]


@pytest.mark.parametrize(("noise", "spread"), [(0.08, 0.0), (0.02, 0.08)], ids=["photograph", "render"])
def test_the_stated_error_is_the_scatter_over_draws_of_noise(noise: float, spread: float) -> None:
    found = draws(50, (1.6, -1.2), noise, spread)
    assert len(found) == 50
    scatter = np.std([(one.right_px, one.down_px) for one in found], axis=0)
    stated = np.sqrt(np.mean([(one.right_se_px**2, one.down_se_px**2) for one in found], axis=0))
    # The scatter of 50 draws is known to 10 %: three times that either way.
    assert np.all(scatter <= 1.3 * stated)
    assert np.all(scatter >= stated / 1.3)


def test_few_are_accused_in_place_and_most_are_found_a_millimetre_beside() -> None:
    """20 balls each, with noise of 1 to 10 % of the brightest pixel, half of it understated.

    By the benchmark's limits the check may report 2 of 100 balls that are in place and miss 5 of 100 that are not; of
    20 balls with fixed seeds, none and 1.
    """
    accused = found = 0
    for number in range(20):
        rng = np.random.default_rng([3, number])
        angle, noise = rng.uniform(0, 2 * np.pi), rng.uniform(0.01, 0.1)
        stated = 0.01 if number % 2 else None
        beside = (np.cos(angle) / PIXEL_MM, np.sin(angle) / PIXEL_MM)
        for offset_px in ((0.0, 0.0), beside):
            pairs = [ball(np.random.default_rng([4, number, light]), offset_px) for light in range(2)]
            images = [compared(render, photo, noise, rng, stated, spread=0.05) for render, photo in pairs]
            told = reported_offset("c0", images, pixels(pairs[0][0]), PIXEL_MM) is not None
            accused, found = (accused + told, found) if offset_px == (0.0, 0.0) else (accused, found + told)
    assert accused == 0
    assert found >= 19


def test_a_rare_bright_path_in_the_render_is_not_taken_for_an_offset() -> None:
    render, photo = ball(np.random.default_rng(1))
    accused = 0
    for seed in range(20):
        rng = np.random.default_rng([5, seed])
        one = compared(render, 0.3 * photo, 0.05, rng)
        y, x = pixels(render)[rng.integers(len(pixels(render)))][::-1]
        one.render[y, x], one.spread[y, x] = 20.0, 19.0  # in one of two renders alone
        accused += reported_offset("c0", [one], pixels(render), PIXEL_MM) is not None
    assert accused == 0


def accused(photo: Array, render: Array, noise: float, count: int) -> list[int]:
    """Seeds of noise for which an offset is reported."""
    images = [compared(render, photo, noise, np.random.default_rng([6, seed])) for seed in range(count)]
    told = [reported_offset("c0", [image], pixels(render), PIXEL_MM) is not None for image in images]
    return [seed for seed, is_told in enumerate(told) if is_told]


def test_a_dim_photograph_in_place_is_not_said_to_lie_elsewhere() -> None:
    # Beside the tooth there is only noise; its variance explains it as well as the render explains the tooth.
    render, _ = ball(np.random.default_rng(1))
    assert accused(0.06 * render, np.where(render > 0, render**0.7, 0.0), 0.05, 12) == []


def test_what_noise_alone_leaves_unexplained_has_no_offset() -> None:
    # 20 captures of noise about a flat render; a shift explains none of it.
    render, _ = ball(np.random.default_rng(1))
    flat = np.where(render > 0, 1.0, 0.0)
    assert accused(flat, flat, 0.3, 20) == []
