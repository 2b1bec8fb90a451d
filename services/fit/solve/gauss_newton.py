"""Gauss-Newton with Monte Carlo Jacobians, as init, step, terminate and finish; the outcome is a value.

The objective is F(x) = 1/2 sum w r(x)^2 + 1/2 sum precision (x - prior)^2 in the unbounded domain. Each step renders
normal equations (curvature from two independent seeds, residual from a third and a fourth), pools them with those of
earlier steps carried to the present point, solves a trust-region subproblem that damps past the most negative
curvature, and proposes a step. The next step renders the equations where the proposal ends, and tests it there.

Two independent estimates of the change of F test a proposal. The comparison is the difference of the losses at both
ends, each the product of the residuals of two seeds: rendered for the equations in any case, it costs nothing. The
model's prediction comes from the quadratic model; its standard error covers the noise of gradient and curvature and a
model error that grows with the step. Far from the optimum the comparison decides; close to it, where losses hardly
differ, the prediction is the more precise. With z = 3 standard errors:

* the two combined are significantly better and do not contradict each other: the step is accepted;
* the comparison is significantly worse or contradicts the prediction: the curvature is wrong, and a shorter step is
  proposed from the same equations;
* otherwise noise stops progress: the proposal is taken where both combined favour it by one standard error, and the
  samples double; at their limit the fit ends, as good as its noise allows.

A fit that ends by noise lies within a few standard errors of the minimum, biased towards its start. So a last Newton
step goes to the minimum of the pooled model, along the directions whose curvature exceeds its noise. It is refused
where a comparison from seeds of its own is significantly worse, or, where derivatives are not those of the images,
where both estimates combined are not better by one standard error. The solution's error is then that of the pooled
gradient, without bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.errors import NonFiniteError
from services.fit.coordinates.domain import Domain
from services.fit.solve.elimination import ReducedEquations, eliminate, weighed
from services.fit.solve.normal_equations import LossChange, NormalEquations, pool
from services.fit.solve.outcome import ADVICE, Result, Solution
from services.fit.solve.solver_state import Proposal, State
from services.fit.solve.step_test import LAST_STEP_Z, SIGNIFICANCE_Z, StepTest, compared
from services.fit.solve.trust_region import solve_box

Array = NDArray[np.float64]


DETERMINED = 3.0
"""A direction counts as determined where its curvature exceeds this many of its own standard deviations."""
CURVED_STEP = 0.1
"""Length of a move of the scan, in scales, beyond which the equations are set up again where the scan is put."""
CURVED_WEIGHT = 3.0
"""Weight of a move of the scan, beside a step of the tissue of as many scales, in how soon earlier equations count
less."""
LONGEST_CURVED_STEP = 2.0
"""Largest length of such a move, in scales."""
SIGNIFICANT_MOVE = 3.0
"""Least ratio of such a move to its own noise."""

WORSE = "worse: radius reduced"
"""Verdict on a proposal that is refused."""
TAKEN, LEFT = "noise: taken", "noise: left"
"""Verdicts on a proposal that noise leaves undecided: taken where both estimates favour it, or else left."""


class Problem(Protocol):
    """Problem to fit. Equal arguments give equal results, so that a repeated step repeats its result."""

    def linearise(self, x: Array, *, samples: int, step: int) -> NormalEquations:
        """Normal equations of the data alone at x."""

    def compare(self, x_old: Array, x_new: Array, *, samples: int, step: int, trial: int) -> LossChange:
        """Change of the data's loss from x_old to x_new with common random numbers that no other call uses."""


@dataclass(frozen=True)
class Options:
    """Limits and thresholds of the solver."""

    max_steps: int = 12
    """Largest number of proposals; one more linearisation tests the last."""
    max_samples: int = 1024
    max_trials: int = 3
    """Largest number of trust radii tried with one set of normal equations."""
    significance_z: float = SIGNIFICANCE_Z
    model_error: float = 0.5
    """Relative error of the predicted change per unit of step length; at length 1 the prediction counts little."""
    slope_error: float = 0.0
    """Relative error of the prediction at any length, where derivatives are not the images' own: the comparison then
    always has some weight."""
    tolerance: float = 0.0
    """Converged where the gain predicted for a further step is at most the gain by noise alone, and that at most this
    change of F."""
    least_radius: float = 1e-3
    part_count: int = 1
    """Number of objects that the images tell apart, such as teeth. A step's length is the root mean square over them,
    so that each may move as far as a single one would."""


@dataclass(frozen=True)
class GaussNewton:
    """Solver for one domain; stateless: states are passed in and returned."""

    domain: Domain
    options: Options = Options()

    def init(self, x: Array, samples: int, previous: Solution | None = None) -> State:
        """State at a start, moved inside the bounds.

        Args:
            previous: outcome of a fit of the same measurements that ended at this very x; its equations are reused.
        """
        low, high = self.domain.bounds
        state = State(np.clip(x, low, high), samples)
        return (
            state
            if previous is None
            else replace(
                state,
                samples=max(samples, previous.samples),
                memory=previous.equations,
                memory_samples=previous.equation_samples,
            )
        )

    def terminate(self, state: State) -> bool:
        """Whether the fit has ended."""
        return state.result is not Result.RUNNING

    def finish(self, state: State) -> Solution:
        """The outcome as a value."""
        return Solution(
            state.x, state.result, ADVICE[state.result], state.step, state.samples, state.memory, state.memory_samples
        )

    def step(self, problem: Problem, state: State) -> State:
        """One linearisation: where a proposal ends, which it tests, or else where the fit stands; then the next
        proposal.

        Raises:
            NonFiniteError: the problem returned NaN or infinity.
        """
        options, verdict = self.options, "a step is proposed"
        place = state.x if state.proposal is None else state.x + state.proposal.step
        fresh = problem.linearise(place, samples=state.samples, step=state.step)
        state = replace(state, step=state.step + 1)
        if state.proposal is None:
            state = self._with_fresh(state, fresh)
        else:
            state = self._tested(state, state.proposal, fresh)
            verdict = state.verdict
            if state.radius < options.least_radius:
                return replace(state, result=Result.STALLED, verdict="worse at every radius")

        # Add the weak prior, which is exact, to curvature and gradient but not to their noise, and eliminate the
        # instrument's errors.
        memory = state.memory
        assert memory is not None
        domain = weighed(self.domain, memory)
        equations = eliminate(memory, domain.precision, domain.prior_slope(state.x), domain.tissue_count)
        noise_gain = gain_by_noise(equations)
        if verdict == WORSE:
            shorter = self._proposal(state, equations, noise_gain) if state.refusals < options.max_trials else None
            if shorter is None:
                state = replace(state, memory=None, memory_samples=0.0)
            return self._with_step_limit(replace(state, proposal=shorter))
        if self._is_far(equations):
            # Images are not linear in the scan's pose: go there and linearise again.
            step = equations.error_step / max(self._curved_length(equations.error_step) / LONGEST_CURVED_STEP, 1.0)
            memory, samples = self._carried(memory, state.memory_samples, step, 0.0)
            state = replace(state, x=state.x + step, memory=memory, memory_samples=samples, loss=None)
            return self._with_step_limit(replace(state, verdict="the scan moved"))

        # Converged: nothing to gain beyond noise, and the noise itself small. Tested at full radius, so that a small
        # radius never looks like convergence.
        _, predicted_gain = self._propose(equations, state.x, max(state.radius, 1.0))
        if predicted_gain <= noise_gain <= options.tolerance and not self._needs_more_samples(equations, state):
            return self._last_step(problem, replace(state, result=Result.CONVERGED, verdict="converged"), equations)
        if verdict not in {TAKEN, LEFT}:
            proposal = self._proposal(state, equations, noise_gain)
            if proposal is not None:
                return self._with_step_limit(replace(state, proposal=proposal, verdict=verdict))
        if state.samples < options.max_samples:
            return self._with_step_limit(
                replace(state, samples=min(2 * state.samples, options.max_samples), verdict="noise: samples doubled")
            )
        ended = replace(state, result=Result.NOISE_LIMITED, verdict="noise: at the sample limit")
        return self._last_step(problem, ended, equations, may_continue=verdict != LEFT)

    def _with_fresh(self, state: State, fresh: NormalEquations) -> State:
        # Pool new equations at x with those of earlier steps, and losses likewise.
        _require_finite(fresh)
        loss = (fresh.loss, fresh.loss_variance)
        if state.loss is not None and state.loss[1] + fresh.loss_variance > 0:
            share = state.loss[1] / (state.loss[1] + fresh.loss_variance)
            loss = (1 - share) * state.loss[0] + share * fresh.loss, share * fresh.loss_variance
        return replace(self._pooled(state, fresh, float(state.samples)), loss=loss, refusals=0)

    def _tested(self, state: State, proposal: Proposal, fresh: NormalEquations) -> State:
        # Accept or refuse a proposal by the losses at both ends. Where noise prevails, take it if both estimates
        # together favour it, and otherwise carry what was rendered there back.
        _require_finite(fresh)
        memory = state.memory
        assert state.loss is not None
        assert memory is not None
        new, z = state.x + proposal.step, self.options.significance_z
        test = StepTest(
            fresh.loss - state.loss[0] + weighed(self.domain, memory).prior_change(state.x, new),
            math.sqrt(fresh.loss_variance + state.loss[1]),
            proposal.change,
            proposal.change_se,
            z,
        )
        is_better, length, radius = test.is_better(z), proposal.length, state.radius
        if not is_better and (test.is_worse or test.is_contradicted):
            return replace(
                state,
                proposal=None,
                refusals=state.refusals + 1,
                radius=0.25 * min(length, radius),
                verdict=WORSE,
            )
        state = replace(state, proposal=None, refusals=0)
        if not is_better and not test.is_better(LAST_STEP_Z):
            back, samples = self._carried(fresh, float(state.samples), -proposal.step, length)
            return replace(self._pooled(state, back, samples), verdict=LEFT)
        memory, samples = self._carried(memory, state.memory_samples, proposal.step, length)
        state = replace(state, x=new, memory=memory, memory_samples=samples, loss=(fresh.loss, fresh.loss_variance))
        state = self._pooled(state, fresh, float(state.samples))
        if not is_better:
            return replace(state, verdict=TAKEN)
        poor = test.change > 0.25 * test.model
        grown = 2 * radius if length > 0.8 * radius and test.change < 0.5 * test.model else radius
        radius = min(0.5 * length if poor and test.is_contradicted else grown, 4.0)
        return replace(state, accepted=state.accepted + 1, radius=radius, verdict="accepted")

    def _proposal(self, state: State, equations: ReducedEquations, noise_gain: float) -> Proposal | None:
        # The step within the radius; None where noise alone would promise its gain.
        step, predicted_gain = self._propose(equations, state.x, state.radius)
        return None if predicted_gain <= noise_gain else self._with_prediction(state, equations, step, noise_gain)

    def _with_prediction(self, state: State, equations: ReducedEquations, step: Array, noise_gain: float) -> Proposal:
        # The predicted change with its standard error; the part that the gradient's own noise causes is subtracted. The
        # instrument's errors go to their optimum too, with a gain that is as uncertain as it is large.
        assert state.memory is not None
        length, change = self._length(step), float(equations.gradient @ step + 0.5 * step @ equations.hessian @ step)
        slope = state.memory.gradient + weighed(self.domain, state.memory).prior_slope(state.x)
        by_errors = 0.5 * float(slope @ equations.error_step)
        relative = self.options.slope_error + self.options.model_error * min(length, 1.0)
        change_se = math.hypot(equations.step_noise(step), relative * change, by_errors)
        whole = equations.error_step + equations.lift @ step
        return Proposal(whole, length, change + noise_gain + by_errors, change_se)

    def _last_step(
        self, problem: Problem, state: State, equations: ReducedEquations, *, may_continue: bool = True
    ) -> State:
        # Newton step along the directions that the data determine: curvature beyond its noise, and noise of the step
        # below one scale.
        memory, count = state.memory, self.domain.tissue_count
        assert memory is not None
        scale, x, error_step = self.domain.scale[:count], state.x[:count], equations.error_step
        eigenvalues, vectors, spread = _spread(equations, scale)
        noise = equations.eigenvalue_noise(scale[:, None] * vectors)
        determined = vectors[
            :,
            (eigenvalues > DETERMINED * noise)
            & (eigenvalues > spread)
            & (eigenvalues > 1e-13 * abs(eigenvalues).max()),
        ]
        curvature = np.einsum("ak,ab,bk->k", determined, equations.hessian * np.outer(scale, scale), determined)
        step = scale * (determined @ (-(determined.T @ (scale * equations.gradient)) / curvature))
        length = self._length(step)
        low, high = (bound[:count] for bound in self.domain.bounds)
        step, noise_gain = np.clip(x + step / max(length, 1.0), low, high) - x, gain_by_noise(equations)
        if length > 1 and may_continue:
            # The step is too long for one linear model: linearise again at its end, or at the first part of it.
            proposal = self._with_prediction(state, equations, step, noise_gain)
            return self._with_step_limit(replace(state, result=Result.RUNNING, proposal=proposal, verdict="settling"))
        if error_step.any():
            memory = memory.moved(error_step)
            state = replace(state, x=state.x + error_step, memory=memory, loss=None)
        if length == 0 or length > 1:
            return state
        prediction, whole = self._with_prediction(state, equations, step, noise_gain), equations.lift @ step
        new = state.x + whole
        change = problem.compare(state.x, new, samples=state.samples, step=state.step - 1, trial=0)
        prior_change = weighed(self.domain, memory).prior_change(state.x, new)
        test = compared(change, prior_change, (prediction.change, prediction.change_se))
        if not test.is_better(LAST_STEP_Z) if self.options.slope_error else test.is_worse:
            return state
        return replace(state, x=new, memory=memory.moved(whole), loss=None, verdict=f"{state.verdict}, settled")

    def _needs_more_samples(self, equations: ReducedEquations, state: State) -> bool:
        # Whether more samples are needed because the step's noise along a direction exceeds one scale. Instrument
        # errors leave little information along such directions, so their gain lies below the tolerance, which is one of
        # the image loss.
        if not self.domain.errors.names or state.samples >= self.options.max_samples:
            return False
        scale = self.domain.scale[: self.domain.tissue_count]
        eigenvalues, spread = _spread(equations, scale)[::2]
        return bool((spread > np.maximum(eigenvalues, 0.0)).any())

    def _length(self, step: Array) -> float:
        # Length of a step of the tissue, in scales.
        scale = self.domain.scale[: self.domain.tissue_count]
        return float(np.linalg.norm(step / scale)) / math.sqrt(self.options.part_count)

    def _propose(self, equations: ReducedEquations, x: Array, radius: float) -> tuple[Array, float]:
        # Step of the tissue within the radius, and the gain that the model predicts for it.
        reach, count = radius * math.sqrt(self.options.part_count), self.domain.tissue_count
        low, high = (bound[:count] for bound in self.domain.bounds)
        step = solve_box(
            equations.hessian,
            equations.gradient,
            x[:count],
            (low, high),
            self.domain.scale[:count],
            reach,
            equations.noise,
        )
        return step, -float(equations.gradient @ step + 0.5 * step @ equations.hessian @ step)

    def _pooled(self, state: State, fresh: NormalEquations, samples: float) -> State:
        # Pool equations at x, worth so many paths, with those of earlier steps.
        if state.memory is None:
            return replace(state, memory=fresh, memory_samples=samples)
        pooled = pool(state.memory, state.memory_samples, fresh, samples)
        return replace(state, memory=pooled, memory_samples=state.memory_samples + samples)

    def _carried(
        self, equations: NormalEquations, samples: float, step: Array, length: float
    ) -> tuple[NormalEquations, float]:
        # Carry equations over a step, and count their samples as fewer after a long one, because the model's error
        # grows with the step while its noise does not.
        whole = math.hypot(length, CURVED_WEIGHT * self._curved_length(step))
        return equations.moved(step), samples / (1 + (whole / 0.3) ** 2)

    def _curved_length(self, step: Array) -> float:
        # Length of the part of a step (F,) that moves the scan, in scales.
        return self.domain.errors.curved_length(step[self.domain.tissue_count :])

    def _is_far(self, equations: ReducedEquations) -> bool:
        # Whether the scan has to move so far that the equations do not hold there, beyond what noise alone does.
        noise = np.sqrt(np.maximum(np.diag(equations.error_noise), 0.0))
        shared = np.concatenate([np.zeros(self.domain.tissue_count), noise])
        least = max(CURVED_STEP, SIGNIFICANT_MOVE * self._curved_length(shared))
        return self._curved_length(equations.error_step) > least

    def _with_step_limit(self, state: State) -> State:
        # At the limit one more linearisation tests a proposal.
        least = self.options.max_steps + (state.proposal is not None)
        return replace(state, result=Result.MAX_STEPS) if state.step >= least else state


def _spread(equations: ReducedEquations, scale: Array) -> tuple[Array, Array, Array]:
    # Eigenvalues and directions of the scaled curvature, and the standard deviation of the gradient along each.
    eigenvalues, vectors = np.linalg.eigh(equations.hessian * np.outer(scale, scale))
    variance = np.einsum("ak,ab,bk->k", vectors, equations.gradient_noise * np.outer(scale, scale), vectors)
    return eigenvalues, vectors, np.sqrt(np.maximum(variance, 0.0))


def gain_by_noise(equations: NormalEquations | ReducedEquations) -> float:
    """Mean gain tr(H^-1 C) / 2 that the gradient's noise alone predicts for a Newton step at the true optimum, over
    directions of positive curvature.
    """
    eigenvalues, vectors = np.linalg.eigh(equations.hessian)
    floor = np.maximum(equations.eigenvalue_noise(vectors), 1e-13 * max(float(np.abs(eigenvalues).max()), 1e-300))
    spread = np.einsum("ak,ab,bk->k", vectors, equations.gradient_noise, vectors)
    return 0.5 * float(np.maximum(spread, 0.0) @ (1 / np.maximum(eigenvalues, floor)))


def _require_finite(equations: NormalEquations) -> None:
    if not math.isfinite(equations.loss) or not math.isfinite(equations.loss_variance):
        raise NonFiniteError("The loss of a step is not finite; check the capture for invalid radiance.")
