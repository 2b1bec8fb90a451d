"""Test of a step by two independent estimates of the change of the objective: a comparison and a prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass

from services.core.errors import NonFiniteError
from services.fit.solve.normal_equations import LossChange

SIGNIFICANCE_Z = 3.0
"""A change is significant beyond this many standard errors: a worse step passes with probability at most 1.3e-3."""
LAST_STEP_Z = 1.0
"""Standard errors by which both estimates combined must favour a step that noise does not let decide."""


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


def compared(change: LossChange, prior_change: float, model: tuple[float, float]) -> StepTest:
    """The test of a step whose two ends were rendered with common random numbers.

    Args:
        change: change of the data's loss.
        prior_change: change of the prior's part of F, which is exact.
        model: the predicted change of F and its standard error.

    Raises:
        NonFiniteError: the change is NaN or infinite.
    """
    if not math.isfinite(change.change) or not math.isfinite(change.variance):
        raise NonFiniteError("The loss of a step is not finite; check the capture for invalid radiance.")
    return StepTest(change.change + prior_change, change.se, *model)


def _combine(first: float, first_se: float, second: float, second_se: float) -> tuple[float, float]:
    # Inverse-variance mean; an estimate without error is used alone, the comparison before the prediction.
    if first_se == 0:
        return first, 0.0
    if second_se == 0:
        return second, 0.0
    a, b = first_se**-2, second_se**-2
    return (a * first + b * second) / (a + b), (a + b) ** -0.5
