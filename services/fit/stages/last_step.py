"""The step that a fit makes after its final uncertainty estimate."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.fit.passes.passes import StackProblem
from services.fit.solve.covariance import FinalModel
from services.fit.solve.step_test import LAST_STEP_Z, compared

Array = NDArray[np.float64]

SLOPE_ERROR = 0.5
"""Relative error of the change that Jacobians of similar media predict for one tooth's exact images, however short the
step; the errors of several teeth are independent."""
FINAL_TRIALS = 2
"""Number of lengths that are tried for the step after the final uncertainty estimate."""
FINAL_MIN_SHARE = 0.1
"""Shortest length that is tried, as a share of the one before."""


def last_step(
    problem: StackProblem[Any], x: Array, model: FinalModel, part_count: int, samples: int
) -> tuple[Array, float]:
    """The step (F,) from x by the final uncertainty estimate, possibly shortened; zeros where its predicted gain is
    within noise or no length is better. With it, the share of the step that remains after it that may be true: 1, or
    how far the minimum is from x by a comparison that refuted the whole step.

    Args:
        part_count: number of objects that the images tell apart; the errors of their predicted changes are independent.
        samples: paths per pixel of a comparison.
    """
    step, share, slope_error = model.step(part_count), 1.0, SLOPE_ERROR / math.sqrt(part_count)
    for trial in range(FINAL_TRIALS):
        predicted, predicted_se = model.predicted_change(step)
        if predicted >= 0:
            break
        expected = predicted, math.hypot(predicted_se, slope_error * predicted)
        change = problem.compare(x, x + step, samples=samples, step=0, trial=trial)
        step_test = compared(change, problem.domain.prior_change(x, x + step), expected)
        if step_test.is_better(LAST_STEP_Z):
            return step, share
        if not (step_test.is_worse or step_test.is_contradicted):
            break
        # Go to the minimum of the parabola through slope and comparison (Nocedal and Wright 2006, section 3.5).
        slope = model.slope(step)
        shorter = max(0.5 * slope / (slope - max(step_test.change, 0.0)), FINAL_MIN_SHARE)
        step, share = shorter * step, shorter * share
    return np.zeros(len(x)), share
