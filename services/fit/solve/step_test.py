"""Test of a step by two independent estimates of the change of the objective: a comparison and a prediction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from services.core.errors import NonFiniteError
from services.fit.solve.normal_equations import LossChange

SIGNIFICANCE_Z = 3.0
"""A change is significant beyond this many standard errors: a worse step passes with probability at most 1.3e-3."""
FIRST_SHARE = 4
"""Divisor of the paths of the first look at a step. It suffices where the step is clearly better: by the comparison far
from the solution, and by the prediction near to it."""
SECOND_LOOK = 1_000
"""Added to the number of a trial, which seeds its renders, for its second look."""


@dataclass(frozen=True)
class StepTest:
    """A step's change of F by comparison and by the model; ``significance_z`` standard errors are significant."""

    change: float
    change_se: float
    model: float
    model_se: float
    significance_z: float = SIGNIFICANCE_Z

    @property
    def is_worse(self) -> bool:
        """Whether the comparison is significantly worse."""
        return self.change > self.significance_z * self.change_se

    @property
    def is_contradicted(self) -> bool:
        """Whether the two estimates differ significantly."""
        return abs(self.change - self.model) > self.significance_z * math.hypot(self.change_se, self.model_se)

    def is_better(self, z: float) -> bool:
        """Whether both estimates combined are better by z standard errors. A comparison that is significantly worse, or
        contradicts the prediction and is worse, overrules them.
        """
        total, total_se = _combine(self.change, self.change_se, self.model, self.model_se)
        return total + z * total_se < 0 and not self.is_worse and not (self.is_contradicted and self.change > 0)


def judged(
    compare: Callable[[int, int], LossChange],
    samples: int,
    trial: int,
    prior_change: float,
    model: tuple[float, float],
    significance_z: float = SIGNIFICANCE_Z,
) -> StepTest:
    """Judge a step by a comparison with a quarter of the paths, and where that is not clearly better by one with all.

    The first only accepts a step, so that few paths refuse none. The second is used alone: where the noise of both
    renders' product prevails, its variance falls with the square of the paths, and the first would add nothing.

    Args:
        compare: compares the data's loss at both ends with so many paths per pixel, as the trial of this number.
        samples: paths per pixel of the second comparison.
        trial: number of the trial.
        prior_change: change of the prior's part of F, which is exact.
        model: the predicted change of F and its standard error.
        significance_z: standard errors that are significant.

    Raises:
        NonFiniteError: the comparison is NaN or infinite.
    """
    for paths, number in ((max(samples // FIRST_SHARE, 1), trial), (samples, trial + SECOND_LOOK)):
        found = compare(paths, number)
        if not math.isfinite(found.change) or not math.isfinite(found.variance):
            raise NonFiniteError("The loss of a step is not finite; check the capture for invalid radiance.")
        test = StepTest(found.change + prior_change, found.se, *model, significance_z)
        if test.is_better(significance_z):
            break
    return test


def _combine(first: float, first_se: float, second: float, second_se: float) -> tuple[float, float]:
    # Inverse-variance mean; an estimate without error is used alone, the comparison before the prediction.
    if first_se == 0:
        return first, 0.0
    if second_se == 0:
        return second, 0.0
    a, b = first_se**-2, second_se**-2
    return (a * first + b * second) / (a + b), (a + b) ** -0.5
