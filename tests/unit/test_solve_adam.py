"""Adam on problems whose truth is known: the published rule, convergence under noise, no NaN, an exact record."""

# ruff: noqa: ARG002 - signatures are those of what is replaced
from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest

from services.core.errors import NonFiniteError
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.adam import ADVICE_MORE_STEPS, Adam, Gradient, Options, State, state_from, state_record
from services.fit.solve.outcome import Result

DOMAIN = Domain(tuple(Coordinate((f"{part}.{leaf}",)) for part in ("enamel", "dentin") for leaf in ("sigma", "alpha")))
BEST = np.array([1.0, 2.5, 2.0, 2.0])


@dataclass
class NoisyQuadratic:
    """F = (x - best)' A (x - best) / 2; the gradient carries Gaussian noise that falls with the samples."""

    a: np.ndarray
    noise: float = 0.0
    seed: int = 0

    def gradient(self, x: np.ndarray, *, samples: int, step: int) -> Gradient:
        rng = np.random.default_rng([self.seed, step, samples])
        slope = self.a @ (x - BEST)
        return Gradient(
            slope + self.noise / np.sqrt(samples) * rng.standard_normal(len(x)), float(0.5 * (x - BEST) @ slope)
        )


def solve(problem: NoisyQuadratic, options: Options, start: np.ndarray, domain: Domain = DOMAIN) -> State:
    solver = Adam(domain, options)
    state = solver.init(start, 64)
    while not solver.terminate(state):
        state = solver.step(problem, state)
        assert np.isfinite(state.x).all()
        low, high = domain.bounds
        assert ((low <= state.x) & (state.x <= high)).all()
    return state


def test_moves_are_those_of_kingma_and_ba() -> None:
    # Algorithm 1, written out for one coordinate of step scale s: gradients and moves are in units of s.
    a, options = np.diag([4.0, 1.0, 9.0, 2.0]), Options(rate=0.1, max_steps=5)
    state, solver = Adam(DOMAIN, options).init(BEST + 0.8, 64), Adam(DOMAIN, options)
    scale, x = DOMAIN.scale, BEST + 0.8
    m, v = np.zeros(4), np.zeros(4)
    for t in range(1, 6):
        g = scale * (a @ (x - BEST))
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        x = x - scale * 0.1 * (m / (1 - 0.9**t)) / np.sqrt(v / (1 - 0.999**t))
        state = solver.step(NoisyQuadratic(a), state)
        # epsilon is 1e-8 of the largest coordinate's size, sizes differ by less than ten
        np.testing.assert_allclose(state.x, x, rtol=0, atol=1e-6)
    assert state.result is Result.MAX_STEPS


def test_converges_under_noise() -> None:
    # Noise is as large as the gradient is at 0.1 to 0.6 step scales from the optimum, and at a constant rate x keeps
    # wandering. Started 1.4 to 2.5 step scales away, 8 seeds ended within 0.15; the bound is twice that,
    # for four of them.
    for seed in range(4):
        problem = NoisyQuadratic(np.diag([40.0, 10.0, 90.0, 20.0]), noise=20.0, seed=seed)
        state = solve(problem, Options(rate=0.03, max_steps=600), BEST + np.array([1.0, -0.8, -1.0, 0.7]))
        assert state.result is Result.CONVERGED
        assert (np.abs(state.x - BEST) < 0.3 * DOMAIN.scale).all()


def test_a_fit_that_still_moves_says_so() -> None:
    solver, state = Adam(DOMAIN), solve(NoisyQuadratic(np.eye(4)), Options(rate=1e-3, max_steps=200), BEST + 1.0)
    solution = solver.finish(state)
    assert not solution.result.converged
    assert solution.advice == ADVICE_MORE_STEPS
    assert solution.equations is None


def test_the_prior_joins_the_gradient() -> None:
    # The prior and the data have equal curvatures, so the result is half way between them.
    domain = Domain((Coordinate(("enamel.alpha",), prior_mean=2.0, prior_sd=0.5),))

    class One(NoisyQuadratic):
        def gradient(self, x: np.ndarray, *, samples: int, step: int) -> Gradient:
            return Gradient(4.0 * (x - 3.0), 0.0)

    state = solve(One(np.eye(1)), Options(rate=0.02, max_steps=500), np.array([1.0]), domain)
    assert abs(state.x[0] - 2.5) < 0.02


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e140])
def test_gradients_of_any_size_give_finite_steps(size: float) -> None:
    state = solve(NoisyQuadratic(size * np.eye(4), noise=size), Options(max_steps=50), BEST + 0.5)
    assert np.isfinite(state.x).all()


def test_what_is_not_finite_is_an_error_not_a_number() -> None:
    solver = Adam(DOMAIN)
    with pytest.raises(NonFiniteError, match="step 1"):
        solver.step(NoisyQuadratic(np.full((4, 4), np.nan)), solver.init(BEST, 64))


def test_state_survives_the_journal_exactly() -> None:
    problem, solver = NoisyQuadratic(np.diag([4.0, 1.0, 9.0, 2.0]), noise=3.0), Adam(DOMAIN)
    state = solver.init(BEST + 1.0, 64)
    for _ in range(3):
        again = state_from(json.loads(json.dumps(state_record(state))))
        state = solver.step(problem, state)
        assert state_record(solver.step(problem, again)) == state_record(state)
