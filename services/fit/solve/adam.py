"""Adam on stochastic gradients, the solver of teeth 2018 (section 6), as init, step, terminate and finish; the outcome
is a value.

Each step renders one gradient J'W r in the unbounded domain, J and r from two independently seeded passes of the same
number of paths per pixel (64 in the paper), and moves by Kingma and Ba's rule with their decay rates. Priors are added
to the gradient; bounds are met by projection. The paper states neither its learning rate nor its stopping rule: here
the rate is constant, in units of the domain's step scale, and a fit ends after ``max_steps``, or when two running means
of x, over the last ``window`` steps and over three times as many, differ by less than ``drift_tolerance`` rates. The
solver estimates no errors, so the reported standard errors come from normal equations that are rendered at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.errors import NonFiniteError
from services.fit.coordinates.domain import Domain
from services.fit.solve.outcome import ADVICE, Result, Solution

Array = NDArray[np.float64]

ADVICE_MORE_STEPS = "Adam still moved at its last step; raise adam_steps, or choose solver = gauss-newton."


@dataclass(frozen=True)
class Gradient:
    """Stochastic gradient (F,) of the data's loss F = 1/2 sum w r^2, and the loss; the residual's Monte Carlo noise
    biases neither.
    """

    gradient: Array
    loss: float

    def __add__(self, other: Gradient) -> Gradient:
        return Gradient(self.gradient + other.gradient, self.loss + other.loss)


class Problem(Protocol):
    """Problem to fit. Equal arguments give equal results."""

    def gradient(self, x: Array, *, samples: int, step: int) -> Gradient:
        """Gradient of the data alone at x."""


@dataclass(frozen=True)
class Options:
    """Rates of Kingma and Ba (2014), and the stopping rule."""

    rate: float = 0.05
    """Learning rate: the usual longest step of a coordinate, in the domain's step scales."""
    mean_decay: float = 0.9
    square_decay: float = 0.999
    epsilon: float = 1e-8
    """Kingma and Ba's epsilon, relative to the largest running gradient, because the loss has no natural unit."""
    max_steps: int = 300
    window: int = 40
    drift_tolerance: float = 2.0
    """Largest difference of the two running means of x, in rates, at which the fit has converged. Steady progress would
    separate them by twice ``window`` rates."""


@dataclass(frozen=True)
class State:
    """State of the solver between steps."""

    x: Array
    samples: int
    mean: Array
    square: Array
    lately: Array
    """Running mean of x over the last ``window`` steps, (F,)."""
    before: Array
    """Running mean of x over three times as many steps, (F,)."""
    step: int = 0
    loss: float = 0.0
    result: Result = Result.RUNNING
    verdict: str = ""


def state_record(state: State) -> dict[str, Any]:
    """A state as JSON values; floats survive exactly."""
    values = {f.name: getattr(state, f.name) for f in fields(State)}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def state_from(record: dict[str, Any]) -> State:
    """The state of a record."""
    arrays = {name: np.array(value, dtype=np.float64) for name, value in record.items() if isinstance(value, list)}
    return State(**(record | arrays | {"result": Result(record["result"])}))


@dataclass(frozen=True)
class Adam:
    """Solver for one domain; stateless: states are passed in and returned."""

    domain: Domain
    options: Options = Options()

    def init(self, x: Array, samples: int) -> State:
        """State at a start, moved inside the bounds."""
        low, high = self.domain.bounds
        start, zero = np.clip(x, low, high), np.zeros(len(x))
        return State(start, samples, zero, zero, start, start)

    def terminate(self, state: State) -> bool:
        """Whether the fit has ended."""
        return state.result is not Result.RUNNING

    def finish(self, state: State) -> Solution:
        """The outcome as a value, without normal equations."""
        advice = ADVICE_MORE_STEPS if state.result is Result.MAX_STEPS else ADVICE[state.result]
        return Solution(state.x, state.result, advice, state.step, state.samples, None)

    def step(self, problem: Problem, state: State) -> State:
        """One gradient and one move.

        Raises:
            NonFiniteError: the problem returned NaN or infinity.
        """
        options, x, number = self.options, state.x, state.step + 1
        found = problem.gradient(x, samples=state.samples, step=state.step)
        prior_mean, precision = self.domain.prior
        if not (np.isfinite(found.gradient).all() and np.isfinite(found.loss)):
            raise NonFiniteError(
                f"The gradient is not finite at step {number}; check the capture for invalid radiance."
            )

        # Convert the gradient to step scales, so that one rate fits all coordinates.
        scale = self.domain.scale
        gradient = scale * (found.gradient + precision * (x - prior_mean))
        mean = options.mean_decay * state.mean + (1 - options.mean_decay) * gradient
        square = options.square_decay * state.square + (1 - options.square_decay) * gradient**2
        size = np.sqrt(square / (1 - options.square_decay**number))
        least = max(options.epsilon * float(size.max(initial=0.0)), 1e-300)
        move = options.rate * (mean / (1 - options.mean_decay**number)) / (size + least)

        low, high = self.domain.bounds
        new = np.clip(x - scale * move, low, high)

        # Single iterates fluctuate by about the rate for ever. Two running means distinguish drift from fluctuation,
        # once both have forgotten the start.
        lately, before = (
            old + (new - old) / span
            for old, span in ((state.lately, options.window), (state.before, 3 * options.window))
        )
        has_converged = (
            number > 3 * options.window
            and float(np.abs((lately - before) / scale).max()) < options.drift_tolerance * options.rate
        )
        result = (
            Result.CONVERGED if has_converged else Result.MAX_STEPS if number >= options.max_steps else Result.RUNNING
        )
        verdict = f"moved by {float(np.linalg.norm((new - x) / scale)):.3f}"
        state = replace(state, x=new, mean=mean, square=square, lately=lately, before=before)
        return replace(state, step=number, loss=found.loss, result=result, verdict=verdict)
