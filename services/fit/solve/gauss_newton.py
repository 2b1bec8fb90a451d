"""Gauss-Newton with Monte Carlo Jacobians, as init, step, terminate and finish; the outcome is a value.

The objective is F(x) = 1/2 sum w r(x)^2 + 1/2 sum precision (x - prior)^2 in the unbounded domain. Each step renders
normal equations (curvature from two independent seeds, residual from a third), pools them with those of earlier steps
carried to the present point, solves a trust-region subproblem that damps past the most negative curvature, and tests
the proposed step.

Two independent estimates of the change of F test a step. The comparison renders the loss at both ends with common
random numbers, from seeds that neither gradient nor curvature used. The model's prediction comes from the quadratic
model; its standard error covers the noise of gradient and curvature and a model error that grows with the step. Far
from the optimum the comparison decides; close to it, where losses hardly differ, the prediction is the more precise.
With z = 3 standard errors:

* the two combined are significantly better and do not contradict each other: the step is accepted;
* the comparison is significantly worse or contradicts the prediction: the curvature is wrong, the radius shrinks;
* otherwise noise stops progress: the samples double; at their limit the fit ends, as good as its noise allows.

A fit that ends by noise lies within a few standard errors of the minimum, biased towards its start. So a last Newton
step goes to the minimum of the pooled model, along the directions whose curvature exceeds its noise. It is refused
where the comparison is significantly worse, or, where derivatives are not those of the images, where both estimates
combined are not better by one standard error. The solution's error is then that of the pooled gradient, without bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain
from services.fit.solve.elimination import ReducedEquations, eliminate
from services.fit.solve.normal_equations import LossChange, NormalEquations, pool
from services.fit.solve.step_test import SIGNIFICANCE_Z, StepTest, judged
from services.fit.solve.trust_region import solve_box

Array = NDArray[np.float64]


class Result(StrEnum):
    """How a fit ended. ``running`` is the only one that continues."""

    RUNNING = "running"
    CONVERGED = "converged"
    NOISE_LIMITED = "noise limited"
    MAX_STEPS = "step limit"
    STALLED = "stalled"

    @property
    def converged(self) -> bool:
        """Whether the optimum was reached within the precision that the samples allow."""
        return self in {Result.CONVERGED, Result.NOISE_LIMITED}


ADVICE = {
    Result.RUNNING: "The fit has not ended.",
    Result.CONVERGED: "",
    Result.NOISE_LIMITED: (
        "Further steps would be smaller than noise; raise max_samples_per_pixel for a smaller standard error."
    ),
    Result.MAX_STEPS: "The fit still improved at its last step; raise max_steps.",
    Result.STALLED: (
        "No step along the gradient lowers the error; check that the mesh, the lights and the boundary model match the"
        " capture."
    ),
}


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
LAST_STEP_Z = 1.0
"""Standard errors by which both estimates combined must favour the last step; no step follows that an error could
mislead."""


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
class State:
    """State of the solver between steps."""

    x: Array
    samples: int
    radius: float = 1.0
    step: int = 0
    accepted: int = 0
    result: Result = Result.RUNNING
    memory: NormalEquations | None = None
    """Pooled normal equations of earlier steps, carried to x."""
    memory_samples: float = 0.0
    verdict: str = ""
    """Outcome of the last step, for the log."""


def state_record(state: State) -> dict[str, Any]:
    """A state as JSON values; floats survive exactly."""
    memory = None if state.memory is None else state.memory.record()
    return {f.name: getattr(state, f.name) for f in fields(State)} | {"x": state.x.tolist(), "memory": memory}


def state_from(record: dict[str, Any]) -> State:
    """The state of a record."""
    memory = None if record["memory"] is None else NormalEquations.of(record["memory"])
    return State(**(record | {"x": np.array(record["x"]), "result": Result(record["result"]), "memory": memory}))


@dataclass(frozen=True)
class Solution:
    """Outcome of a fit: the solution, how the fit ended, and what to do about it."""

    x: Array
    result: Result
    advice: str
    steps: int
    samples: int
    equations: NormalEquations | None
    """Pooled normal equations at x; None where the last step discarded them."""
    equation_samples: float = 0.0
    """Paths per pixel that ``equations`` are worth."""


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
        """One linearisation and up to ``max_trials`` comparisons.

        Raises:
            NonFiniteError: the problem returned NaN or infinity.
        """
        options, x = self.options, state.x
        pooled, samples = problem.linearise(x, samples=state.samples, step=state.step), float(state.samples)
        if state.memory is not None:
            pooled, samples = pool(state.memory, state.memory_samples, pooled, samples), state.memory_samples + samples
        state = replace(state, step=state.step + 1, memory=pooled, memory_samples=samples)

        # Add the weak prior, which is exact, to curvature and gradient but not to their noise, and eliminate the
        # instrument's errors.
        equations = eliminate(pooled, self.domain.precision, self.domain.prior_slope(x), self.domain.tissue_count)
        best, error_step = x + equations.error_step, equations.error_step
        if self._is_far(equations):
            # Images are not linear in the scan's pose: go there and linearise again.
            error_step = error_step / max(self._curved_length(error_step) / LONGEST_CURVED_STEP, 1.0)
            return self._with_step_limit(
                self._carry(replace(state, x=x + error_step, verdict="the scan moved"), error_step, 0.0)
            )
        noise_gain = gain_by_noise(equations)

        # Converged: nothing to gain beyond noise, and the noise itself small. Tested at full radius, so that a small
        # radius never looks like convergence.
        _, predicted_gain = self._propose(equations, x, max(state.radius, 1.0))
        if predicted_gain <= noise_gain <= options.tolerance and not self._needs_more_samples(equations, state):
            return self._last_step(problem, replace(state, result=Result.CONVERGED, verdict="converged"), equations)

        radius, is_model_wrong = state.radius, False
        for trial in range(options.max_trials if predicted_gain > noise_gain else 0):
            step, predicted_gain = self._propose(equations, x, radius)
            if predicted_gain <= noise_gain:
                break
            new, length = best + equations.lift @ step, self._length(step)
            # Prediction and comparison, each with its standard error; the part of the prediction that the gradient's
            # own noise causes is subtracted.
            model_se = math.hypot(
                equations.step_noise(step), (options.slope_error + options.model_error * length) * predicted_gain
            )
            step_test = self._judged(problem, (best, new), state, trial, (noise_gain - predicted_gain, model_se))
            if step_test.is_better(options.significance_z):
                poor = step_test.change > 0.25 * step_test.model
                grown = 2 * radius if length > 0.8 * radius and step_test.change < 0.5 * step_test.model else radius
                state = replace(
                    state,
                    x=new,
                    accepted=state.accepted + 1,
                    radius=min(0.5 * length if poor and step_test.is_contradicted else grown, 4.0),
                    verdict="accepted",
                )
                return self._with_step_limit(self._carry(state, error_step + equations.lift @ step, length))
            is_model_wrong = step_test.is_worse or step_test.is_contradicted
            if not is_model_wrong:
                break
            radius = 0.25 * min(length, radius)
            if radius < options.least_radius:
                return replace(state, result=Result.STALLED, verdict="worse at every radius")
        if is_model_wrong:
            return self._with_step_limit(
                replace(state, radius=radius, memory=None, memory_samples=0.0, verdict="worse: radius reduced")
            )
        if state.samples < options.max_samples:
            return self._with_step_limit(
                replace(state, samples=min(2 * state.samples, options.max_samples), verdict="noise: samples doubled")
            )
        return self._last_step(
            problem, replace(state, result=Result.NOISE_LIMITED, verdict="noise: at the sample limit"), equations
        )

    def _last_step(self, problem: Problem, state: State, equations: ReducedEquations) -> State:
        # Newton step along the directions that the data determine: curvature beyond its noise, and noise of the step
        # below one scale.
        count = self.domain.tissue_count
        scale, x, error_step = self.domain.scale[:count], state.x[:count], equations.error_step
        if state.memory is not None and error_step.any():
            state = replace(state, x=state.x + error_step, memory=state.memory.moved(error_step))
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
        if state.memory is None or length == 0:
            return state
        low, high = (bound[:count] for bound in self.domain.bounds)
        step = np.clip(x + step / max(length, 1.0), low, high) - x

        new, whole = state.x + equations.lift @ step, equations.lift @ step
        options, model = self.options, float(equations.gradient @ step + 0.5 * step @ equations.hessian @ step)
        model_se = math.hypot(
            equations.step_noise(step), (options.slope_error + options.model_error * min(length, 1.0)) * model
        )
        given = (state.x, new), state, options.max_trials, (model + gain_by_noise(equations), model_se)
        step_test = self._judged(problem, *given)
        refused = not step_test.is_better(LAST_STEP_Z) if options.slope_error else step_test.is_worse
        if refused:
            return state
        if length > 1:
            # The step is too long for one linear model: linearise again from its end.
            return self._with_step_limit(
                self._carry(replace(state, x=new, result=Result.RUNNING, verdict="settling"), whole, 1.0)
            )
        return replace(state, x=new, memory=state.memory.moved(whole), verdict=f"{state.verdict}, settled")

    def _judged(
        self, problem: Problem, ends: tuple[Array, Array], state: State, trial: int, model: tuple[float, float]
    ) -> StepTest:
        old, new = ends
        step, prior_change = state.step - 1, self.domain.prior_change(old, new)

        def compare(samples: int, number: int) -> LossChange:
            return problem.compare(old, new, samples=samples, step=step, trial=number)

        return judged(compare, state.samples, trial, prior_change, model, self.options.significance_z)

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

    def _carry(self, state: State, step: Array, length: float) -> State:
        # Count the pooled samples as fewer after a long step, because the model's error grows with the step while its
        # noise does not.
        assert state.memory is not None
        whole = math.hypot(length, CURVED_WEIGHT * self._curved_length(step))
        return replace(
            state, memory=state.memory.moved(step), memory_samples=state.memory_samples / (1 + (whole / 0.3) ** 2)
        )

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
        return replace(state, result=Result.MAX_STEPS) if state.step >= self.options.max_steps else state


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
