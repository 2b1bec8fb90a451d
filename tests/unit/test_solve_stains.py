"""Steps of a stain texture on a product model whose truth is known: they lower F, find the texture, and do not change
what nobody sees.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from services.fit.solve.stains import DEEPEST, LONGEST_STEP, StainSolver, StainState, StainSums, clean_state

TEXELS = 60
CHAIN = np.stack([np.arange(TEXELS - 1), np.arange(1, TEXELS)], axis=1)
SOLVER = StainSolver(CHAIN, TEXELS)
UNSEEN = slice(50, TEXELS)


@dataclass
class Toy:
    """C_p = light_p exp(-sum_t S_pt d_t): on its way out the light passes one texel with a share of 1; on its way in, a
    second share of 1 is spread over the texels around it.
    """

    light: np.ndarray
    shares: np.ndarray
    reference: np.ndarray
    leaving: np.ndarray
    """The part of ``shares`` that is light on its way out."""
    weight: float
    noise: float = 0.0

    @staticmethod
    def of(depth: np.ndarray, seed: int = 1, pixels: int = 400, noise: float = 0.0, *, between: bool = False) -> Toy:
        """A model whose pixels show one texel each, or a point between two of them."""
        rng = np.random.default_rng(seed)
        seen = rng.integers(0, 50, pixels)
        spread = np.exp(-0.5 * ((np.arange(TEXELS)[None] - seen[:, None]) / 3.0) ** 2)
        spread[:, UNSEEN] = 0.0
        light = rng.uniform(0.5, 1.5, pixels)
        way = rng.uniform(size=(pixels, 1)) if between else np.zeros((pixels, 1))
        leaving = (1 - way) * np.eye(TEXELS)[seen] + way * np.eye(TEXELS)[np.minimum(seen + 1, 49)]
        shares = leaving + spread / spread.sum(axis=1, keepdims=True)
        return Toy(light, shares, light * np.exp(-shares @ depth), leaving, 1e4, noise)

    def image(self, depth: np.ndarray) -> np.ndarray:
        return np.asarray(self.light * np.exp(-self.shares @ depth))

    def loss(self, depth: np.ndarray) -> float:
        return float(0.5 * self.weight * ((self.image(depth) - self.reference) ** 2).sum())

    def exits(self, depth: np.ndarray) -> Any:
        return sparse.csr_matrix(self.leaving.T @ (self.weight * self.image(depth)[:, None] ** 2 * self.leaving))

    def sums(self, depth: np.ndarray, seed: int = 0) -> StainSums:
        # Two independent renders, as in a fit: one for the cotangents, one for the shares.
        rng = np.random.default_rng(seed)
        first, second = (self.image(depth) * (1 + self.noise * rng.standard_normal(len(self.light))) for _ in range(2))
        carried, explained = (self.weight * (c * second) @ self.shares for c in (first, self.reference))
        return StainSums(explained, carried, 2 * self.loss(depth))


def truth(low: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(7)
    depth = np.where(rng.uniform(size=TEXELS) < 0.3, low, rng.uniform(low, 0.6, TEXELS))
    depth[UNSEEN] = 0.0
    return depth


def test_ratio_steps_lower_the_loss_however_uneven_the_texture() -> None:
    # Without noise the bound holds for any texture, as long as nothing is shifted: here a third of the surface is clean
    # and the first render is too bright.
    toy, state = Toy.of(truth()), clean_state(TEXELS)
    for _ in range(6):
        before, state = toy.loss(state.depth), SOLVER.ratio_step(state, toy.sums(state.depth))
        assert toy.loss(state.depth) < before
        assert (state.depth >= 0).all()


def test_ratio_steps_find_the_pattern_when_the_render_is_too_dark() -> None:
    # The media have absorbed the mean of the stain, so clean parts are brighter than the render. The pattern is found
    # up to a common depth.
    toy, state = Toy.of(truth()), clean_state(TEXELS)
    toy.light = toy.light * 0.6
    for _ in range(2):
        state = SOLVER.ratio_step(state, toy.sums(state.depth))
    seen = slice(0, 50)
    assert np.corrcoef(state.depth[seen], truth()[seen])[0, 1] > 0.7


def test_exact_steps_find_the_texture() -> None:
    # What remains after seven steps is the slowest direction, (1 - 1/4) for each step, reduced by momentum to 0.48, and
    # the prior, at most 1e-3 of the data here.
    toy, state = Toy.of(truth()), clean_state(TEXELS)
    for step in range(20):
        state = SOLVER.exact_step(state, toy.sums(state.depth), 0)
        if step == 6:
            assert np.sqrt(np.mean((state.depth - truth())[:50] ** 2)) < 0.05
    assert np.abs(state.depth - truth())[:50].max() < 0.02


def test_shorter_steps_average_noise() -> None:
    errors = {}
    for name, slower in (("constant", 0), ("falling", 1)):
        ends = []
        for seed in range(12):
            toy, state = Toy.of(truth(0.1), noise=0.2), clean_state(TEXELS)
            for step in range(16):
                state = SOLVER.exact_step(state, toy.sums(state.depth, 100 * seed + step), slower * step)
            ends.append(state.depth[:50])
        errors[name] = np.std(ends, axis=0).mean()
    assert errors["falling"] < 0.8 * errors["constant"]


@pytest.mark.parametrize(("noise", "pixels"), [(0.02, 400), (0.1, 400), (0.3, 400), (0.02, 40), (0.1, 40)])
def test_standard_errors_hold_the_truth(noise: float, pixels: int) -> None:
    # Eight textures, photographs with noise of their mean's ``noise``, and renders with Monte Carlo noise of 5 %, by
    # the steps of a fit. Of the 400 errors, correlated over some three texels, 95 % are within two standard errors
    # with a standard deviation of 2 %. The curvature is a lower limit, and smoothing counts for every texel as for one
    # that few pixels show, so that errors may be smaller; were they three times too large, this would be known as well.
    pulls = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        depth = np.clip(np.abs(np.cumsum(rng.normal(0, 0.2, TEXELS))), 0, 1.5)
        toy, state = Toy.of(depth, seed, pixels, noise=0.05, between=True), clean_state(TEXELS)
        spread = noise * toy.reference.mean()
        toy.reference = toy.reference + spread * rng.standard_normal(len(toy.reference))
        toy.weight = 1 / spread**2
        steps = (SOLVER.ratio_step,) * 2 + (SOLVER.pattern_step,) * 3
        for number, solve in enumerate(steps + tuple(partial(SOLVER.exact_step, number=k) for k in range(5))):
            state = solve(state, toy.sums(state.depth, 100 * seed + number))
        sums = replace(toy.sums(state.depth, 100 * seed + 99), count=len(toy.reference))
        errors = SOLVER.depth_errors(state.depth, sums, toy.exits(state.depth))
        assert (errors[:50] > 0).all()
        # The end of the chain is ten texels from what is seen. A chain that goes on without end under the two priors
        # has precision p = 1 / 0.5^2 + 1 / (0.2^2 + 1 / p) = 12.2 there; deeper stains than these expect widen it.
        assert errors[-1] > 0.99 * 12.2**-0.5
        pulls.append(((state.depth - depth) / errors)[:50])
    within = (np.abs(pulls) < 2).mean()
    assert within > 0.91
    assert np.sqrt(np.mean(np.square(pulls))) > 0.33


def test_residuals_beyond_noise_widen_the_errors() -> None:
    toy, depth = Toy.of(truth(0.1)), truth(0.1)
    sums = toy.sums(depth)
    usual, less, more = (
        SOLVER.depth_errors(depth, replace(sums, squares=squares, count=400), toy.exits(depth))
        for squares in (400.0, 4.0, 3600.0)
    )
    np.testing.assert_array_equal(usual, less)
    # Where the data alone count, errors go with the root of 9, and with the prior's share less.
    assert 2.5 < (more / usual)[:50].max() <= 3.0 + 1e-9
    assert more[-1] == pytest.approx(usual[-1], rel=0.05)


def test_what_nobody_sees_stays_clean() -> None:
    toy, state = Toy.of(truth()), clean_state(TEXELS)
    for step in range(10):
        state = SOLVER.exact_step(state, toy.sums(state.depth), step)
    assert not state.determined[UNSEEN].any()
    assert state.determined[:50].any()
    # Neighbours pull the first of these texels; ten texels away the prior dominates.
    assert state.depth[-1] < 0.25 * max(state.depth[49], 0.04)


@pytest.mark.parametrize("value", [0.0, -5.0, 1e-290, 1e290])
def test_sums_of_any_size_give_finite_steps_of_a_stated_length(value: float) -> None:
    rng = np.random.default_rng(3)
    sums = StainSums(value * rng.uniform(-1, 1, TEXELS), value * rng.uniform(-1, 1, TEXELS), 0.0)
    state = clean_state(TEXELS)
    for step in range(4):
        for moved in (SOLVER.ratio_step(state, sums), SOLVER.exact_step(state, sums, step)):
            assert np.isfinite(moved.depth).all()
            assert ((moved.depth >= 0) & (moved.depth <= DEEPEST)).all()
        after = SOLVER.exact_step(state, sums, step)
        assert np.abs(after.depth - state.depth).max() <= LONGEST_STEP + 1e-12
        state = after


def test_a_state_survives_the_journal_exactly() -> None:
    toy = Toy.of(truth(), noise=0.1)
    state = SOLVER.exact_step(
        SOLVER.ratio_step(clean_state(TEXELS), toy.sums(np.zeros(TEXELS))), toy.sums(np.zeros(TEXELS)), 0
    )
    again = StainState.of(json.loads(json.dumps(state.record())))
    assert again.record() == state.record()
    assert (
        SOLVER.exact_step(again, toy.sums(again.depth), 1).depth
        == SOLVER.exact_step(state, toy.sums(state.depth), 1).depth
    ).all()
