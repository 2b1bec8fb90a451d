"""The solver on problems whose truth is known: it converges, never produces NaN, and never takes a worse step."""

# ruff: noqa: ARG002 - signatures are those of what is replaced
from __future__ import annotations

import json
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from services.core.errors import NonFiniteError
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.solve.gauss_newton import GaussNewton, Options
from services.fit.solve.normal_equations import LossChange, NormalEquations
from services.fit.solve.outcome import ADVICE, Result
from services.fit.solve.solver_state import State, state_from, state_record
from services.fit.solve.trust_region import solve_ball
from tests.support.curvature import isotropic

NAMES = ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha", "enamel.g1", "dentin.g1")


@dataclass
class Quadratic:
    """F = (x - best)' A (x - best) / 2, seen through noise that falls with the samples."""

    a: np.ndarray
    best: np.ndarray
    gradient_noise: float = 0.0
    hessian_noise: float = 0.0
    loss_noise: float = 0.0
    calls: list[tuple[str, int]] = field(default_factory=list)
    seed: int = 0

    def loss(self, x: np.ndarray) -> float:
        return float(0.5 * (x - self.best) @ self.a @ (x - self.best))

    def linearise(self, x: np.ndarray, *, samples: int, step: int) -> NormalEquations:
        rng, count = np.random.default_rng([self.seed, step, samples]), len(x)
        self.calls.append(("linearise", samples))
        g, h = self.gradient_noise / np.sqrt(samples), self.hessian_noise / np.sqrt(samples)
        shake = rng.standard_normal((count, count))
        symmetric = h * (shake + shake.T) / 2
        gradient, none = self.a @ (x - self.best) + g * rng.standard_normal(count), np.zeros((count, count))
        noise = self.loss_noise / np.sqrt(samples)
        loss = self.loss(x) + noise * rng.standard_normal()
        own = isotropic(count, h**2), g**2 * np.eye(count), none
        return NormalEquations(self.a + symmetric, gradient, *own, loss=loss, loss_variance=noise**2)

    def compare(self, x_old: np.ndarray, x_new: np.ndarray, *, samples: int, step: int, trial: int) -> LossChange:
        self.calls.append(("compare", samples))
        noise = self.loss_noise / np.sqrt(samples)
        change = (
            self.loss(x_new)
            - self.loss(x_old)
            + noise * np.random.default_rng([self.seed, step, trial, samples, 1]).standard_normal()
        )
        return LossChange(change, noise**2)


def _domain(count: int) -> Domain:
    return Domain(tuple(Coordinate((name,)) for name in NAMES[:count]))


def _random_problem(rng: np.random.Generator) -> tuple[Quadratic, Domain, np.ndarray]:
    count = int(rng.integers(2, 7))
    domain = _domain(count)
    low, high = domain.bounds
    basis = np.linalg.qr(rng.standard_normal((count, count)))[0]
    spectrum = 10.0 ** rng.uniform(-6, 6, count)
    start, best = (low + (high - low) * rng.uniform(0.2, 0.8, count) for _ in range(2))
    return Quadratic((basis * spectrum) @ basis.T, best), domain, start


def test_ill_conditioned_or_indefinite_systems_never_worsen() -> None:
    rng, improved = np.random.default_rng(1), 0
    for case in range(150):
        problem, domain, x = _random_problem(rng)
        problem.seed = case
        size = float(np.abs(problem.a).max())
        problem.gradient_noise = size * 10.0 ** rng.uniform(-4, 2)
        problem.hessian_noise = size * 10.0 ** rng.uniform(-2, 2)
        solver = GaussNewton(domain, Options(max_steps=6, max_samples=256))
        state = solver.init(x, 64)
        first = problem.loss(state.x)
        while not solver.terminate(state):
            before = problem.loss(state.x)
            state = solver.step(problem, state)
            assert np.isfinite(state.x).all()
            # The comparison is exact here, so the rule must hold exactly.
            assert problem.loss(state.x) <= before
        improved += problem.loss(state.x) < first
    assert improved > 75


def test_pure_noise_moves_no_further_than_its_stated_rate() -> None:
    # A flat problem: every accepted step is a false alarm. At z = 3 the one test of a step passes with 1.35e-3; 100
    # systems x 5 steps give at most 0.7 on average, and more than 4 with probability 1e-3 (Poisson).
    accepted = 0
    for case in range(100):
        problem = Quadratic(
            np.zeros((4, 4)), np.zeros(4), gradient_noise=1.0, hessian_noise=1.0, loss_noise=1.0, seed=case
        )
        domain = _domain(4)
        low, high = domain.bounds
        solver = GaussNewton(domain, Options(max_steps=5, max_samples=1024))
        state = solver.init((low + high) / 2, 64)
        while not solver.terminate(state):
            state = solver.step(problem, state)
            assert np.isfinite(state.x).all()
        accepted += state.accepted
    assert accepted <= 4


def test_noisy_systems_take_worse_steps_no_more_often_than_stated() -> None:
    # One third each ill-conditioned, indefinite and nothing but noise, and the losses themselves are noisy. A step that
    # is accepted although it is worse is a false alarm at z = 3: at most 1.35e-3 of all tests. Their number is Poisson
    # distributed; four standard deviations and one above its mean is one case in 10,000. A step that noise does not let
    # decide, and the last one, to the minimum of all that is known, are refused only when they are surely worse, so
    # they may lose as much as a test cannot detect: with 3 standard errors to refuse and one case in 150,000 to be
    # missed, 7.5 of them, each that of a difference of two losses.
    rng, worse, compared = np.random.default_rng(5), 0, 0
    for case in range(300):
        problem, domain, x = _random_problem(rng)
        if case % 3 == 1:
            problem.a = problem.a - 0.3 * float(np.abs(problem.a).max()) * np.eye(len(x))
        if case % 3 == 2:
            problem.a = np.zeros_like(problem.a)
        problem.seed, size = case, max(float(np.abs(problem.a).max()), 1.0)
        problem.gradient_noise, problem.hessian_noise, problem.loss_noise = size * 10.0 ** rng.uniform(-3, 2, 3)
        solver = GaussNewton(domain, Options(max_steps=6, max_samples=256))
        state = solver.init(x, 64)
        while not solver.terminate(state):
            before = state
            state = solver.step(problem, state)
            assert np.isfinite(state.x).all()
            assert state.memory is None or np.isfinite(state.memory.gradient).all()
            change = problem.loss(state.x) - problem.loss(before.x)
            if state.accepted > before.accepted:
                worse += change > 0
            else:
                assert change <= 7.5 * problem.loss_noise * np.sqrt(2 / before.samples)
        compared += sum(kind == "linearise" for kind, _ in problem.calls)
    expected = 1.35e-3 * compared
    assert worse <= expected + 4 * np.sqrt(expected) + 1


def test_converges_on_a_well_posed_problem_with_noise() -> None:
    # At the end the error of x is that of the gradient: noise / sqrt(pooled samples) / curvature; 5 sigma.
    a = np.diag([4.0, 1.0, 9.0, 2.0])
    domain = _domain(4)
    best = np.array([1.0, 2.5, 2.0, 2.0])
    for seed in range(8):
        problem = Quadratic(a, best, gradient_noise=1.0, hessian_noise=0.5, loss_noise=0.5, seed=seed)
        solver = GaussNewton(domain, Options(max_steps=40, max_samples=4096, tolerance=1e-4))
        state = solver.init(best + np.array([1.0, -0.8, -1.0, 0.7]), 64)
        while not solver.terminate(state):
            state = solver.step(problem, state)
        solution = solver.finish(state)
        assert solution.result.converged, solution
        assert problem.loss(solution.x) < 0.5 * 4 * 25 / 4096 / 1.0 + 1e-2


def test_samples_double_only_for_noise() -> None:
    domain, best = _domain(2), np.array([1.0, 2.0])
    exact = Quadratic(np.diag([1.0, 1e4]), best)
    solver = GaussNewton(domain, Options(max_steps=30))
    state = solver.init(best + np.array([2.0, 1.5]), 64)
    while not solver.terminate(state) and exact.loss(state.x) > 1e-8:
        state = solver.step(exact, state)
    assert state.samples == 64
    noisy = Quadratic(np.diag([1e-3, 1e-3]), best, gradient_noise=1.0, loss_noise=1.0)
    state = solver.init(best, 64)
    while not solver.terminate(state):
        state = solver.step(noisy, state)
    assert state.samples == 1024
    assert state.result is Result.NOISE_LIMITED


def test_uphill_model_stalls_with_advice() -> None:
    start = np.array([1.0, 2.0])

    class Uphill(Quadratic):
        def loss(self, x: np.ndarray) -> float:
            return float((x != start).any())

    solver = GaussNewton(_domain(2), Options(max_steps=40))
    state = solver.init(start, 64)
    while not solver.terminate(state):
        state = solver.step(Uphill(np.eye(2), np.zeros(2)), state)
    solution = solver.finish(state)
    assert solution.result is Result.STALLED
    assert solution.advice == ADVICE[Result.STALLED] != ""
    assert (solution.x == start).all()


def test_not_finite_input_is_an_error_not_a_number() -> None:
    with pytest.raises(NonFiniteError):
        solve_ball(np.array([[np.nan]]), np.ones(1), 1.0)
    problem = Quadratic(np.eye(2), np.array([np.nan, 0.0]))
    with pytest.raises(NonFiniteError):
        GaussNewton(_domain(2)).step(problem, GaussNewton(_domain(2)).init(np.array([1.0, 2.0]), 64))


def test_state_survives_the_journal_exactly() -> None:
    problem = Quadratic(
        np.diag([4.0, 1.0]), np.array([1.0, 2.0]), gradient_noise=1.0, hessian_noise=0.3, loss_noise=0.1
    )
    solver = GaussNewton(_domain(2), Options(max_steps=4))
    state = solver.step(problem, solver.init(np.array([2.0, 3.0]), 64))
    again = state_from(json.loads(json.dumps(state_record(state))))
    assert state_record(solver.step(problem, again)) == state_record(solver.step(problem, state))


def test_a_stage_that_goes_on_with_the_same_measurements_forgets_nothing() -> None:
    # The start has only noise, so nothing moves; the variances of pooled gradients add up to those of 256 and 512 paths
    # in one render.
    problem, domain = Quadratic(np.eye(2), np.array([1.0, 2.0]), gradient_noise=1.0, loss_noise=100.0), _domain(2)
    solver = GaussNewton(domain, Options(max_samples=512))
    first = solver.step(problem, solver.init(problem.best, 256))
    ended = solver.finish(first)
    again = solver.init(ended.x, 128, ended)
    assert (again.samples, again.memory_samples) == (ended.samples, 256.0)
    second = solver.step(replace(problem, seed=1), again)
    assert second.memory_samples == 256.0 + again.samples
    assert second.memory is not None
    np.testing.assert_allclose(second.memory.gradient_noise, np.eye(2) / second.memory_samples)


def test_trust_region_step_is_the_constrained_minimum() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        root = rng.standard_normal((3, 3))
        h, g, radius = root @ root.T, rng.standard_normal(3), float(rng.uniform(0.05, 2))
        step = solve_ball(h, g, radius)
        assert np.linalg.norm(step) <= radius * (1 + 1e-9)
        value = g @ step + 0.5 * step @ h @ step
        for _ in range(200):
            other = rng.standard_normal(3)
            other *= radius * rng.uniform(0, 1) / np.linalg.norm(other)
            assert value <= g @ other + 0.5 * other @ h @ other + 1e-9


@dataclass
class Overpromising(Quadratic):
    """The derivatives belong to another loss than the one compared: they promise a gain where 0.4 is lost."""

    seen: float = 0.0
    """Standard error of a difference of two losses."""

    def linearise(self, x: np.ndarray, *, samples: int, step: int) -> NormalEquations:
        found = super().linearise(x, samples=samples, step=step)
        return replace(found, loss=0.4 * float(x.any()), loss_variance=0.5 * self.seen**2)

    def compare(self, x_old: np.ndarray, x_new: np.ndarray, *, samples: int, step: int, trial: int) -> LossChange:
        return LossChange(0.4, self.seen**2)


def after_one_test(solver: GaussNewton, problem: Quadratic, start: np.ndarray) -> State:
    """The state after a first proposal and its test."""
    return solver.step(problem, solver.step(problem, solver.init(start, 64)))


def test_a_short_step_that_only_borrowed_derivatives_promise_is_not_taken() -> None:
    # The promise, 408 x 0.07^2 = 2, is for a fifth of a unit of length, so the model's own error is 0.2; the comparison
    # shows nothing, 0.4 +- 1.
    problem = Overpromising(np.diag([816.0, 816.0]), np.array([0.07, 0.0]), seen=1.0)
    domain = Domain((Coordinate(("enamel.g1",)), Coordinate(("dentin.g1",))))
    start = np.zeros(2)
    trusting, doubting = (GaussNewton(domain, Options(max_samples=64, slope_error=error)) for error in (0.0, 0.5))
    assert after_one_test(trusting, problem, start).accepted == 1
    # With a model's error of 1.2 both estimates together are 0.8 standard errors in favour.
    refused = after_one_test(doubting, problem, start)
    assert refused.accepted == 0
    assert refused.result is Result.NOISE_LIMITED
    np.testing.assert_array_equal(refused.x, start)
    # What was rendered at the other end counts, carried back.
    assert refused.memory_samples > 64


def test_where_noise_prevails_a_step_goes_where_both_estimates_together_point() -> None:
    # The promise is 2 again, with a relative uncertainty of 0.6. A comparison of 0.4 +- 10 shows nothing, so the
    # promise stays at 1.6 standard errors: too few to be accepted, enough to be taken. A comparison of 0.4 +- 0.1
    # refutes it.
    domain = Domain((Coordinate(("enamel.g1",)), Coordinate(("dentin.g1",))))
    solver, start = GaussNewton(domain, Options(max_samples=64, slope_error=0.5)), np.zeros(2)
    taken, refuted = (
        after_one_test(solver, Overpromising(np.diag([816.0, 816.0]), np.array([0.07, 0.0]), seen=seen), start)
        for seen in (10.0, 0.1)
    )
    assert (taken.accepted, refuted.accepted) == (0, 0)
    assert taken.result is Result.NOISE_LIMITED
    np.testing.assert_allclose(taken.x, [0.07, 0.0])
    np.testing.assert_array_equal(refuted.x, start)
    # A shorter step is proposed from the same equations.
    assert refuted.result is Result.RUNNING
    assert refuted.proposal is not None
    assert refuted.proposal.length == pytest.approx(0.05)


def test_equations_serve_a_few_shorter_steps_and_are_then_rendered_anew() -> None:
    problem = Overpromising(np.diag([816.0, 816.0]), np.array([0.7, 0.0]), seen=0.0)
    domain = Domain((Coordinate(("enamel.g1",)), Coordinate(("dentin.g1",))))
    solver = GaussNewton(domain, Options(max_trials=2, least_radius=1e-9))
    state = solver.init(np.zeros(2), 64)
    places, known = list[float](), list[bool]()
    for _ in range(4):
        state = solver.step(problem, state)
        places.append(0.0 if state.proposal is None else state.proposal.length)
        known.append(state.memory is not None)
    assert known == [True, True, False, True]
    assert places == pytest.approx([1.0, 0.25, 0.0, 0.0625])
