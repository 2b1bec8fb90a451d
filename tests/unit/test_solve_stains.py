"""Steps of a stain texture on a product model whose truth is known: they lower F, find the texture, and do not change
what nobody sees.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest

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
    weight: float
    noise: float = 0.0

    @staticmethod
    def of(depth: np.ndarray, seed: int = 1, pixels: int = 400, noise: float = 0.0) -> Toy:
        rng = np.random.default_rng(seed)
        seen = rng.integers(0, 50, pixels)
        spread = np.exp(-0.5 * ((np.arange(TEXELS)[None] - seen[:, None]) / 3.0) ** 2)
        spread[:, UNSEEN] = 0.0
        shares = np.eye(TEXELS)[seen] + spread / spread.sum(axis=1, keepdims=True)
        light = rng.uniform(0.5, 1.5, pixels)
        return Toy(light, shares, light * np.exp(-shares @ depth), 1e4, noise)

    def image(self, depth: np.ndarray) -> np.ndarray:
        return np.asarray(self.light * np.exp(-self.shares @ depth))

    def loss(self, depth: np.ndarray) -> float:
        return float(0.5 * self.weight * ((self.image(depth) - self.reference) ** 2).sum())

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
