"""Test of a step by two independent estimates of the change of the objective: a comparison and a prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class StepTest:
    """A step's change of F by comparison and by the model; ``significance_z`` standard errors are significant."""

    change: float
    change_se: float
    model: float
    model_se: float
    significance_z: float = 3.0

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


def _combine(first: float, first_se: float, second: float, second_se: float) -> tuple[float, float]:
    # Inverse-variance mean; an estimate without error is used alone, the comparison before the prediction.
    if first_se == 0:
        return first, 0.0
    if second_se == 0:
        return second, 0.0
    a, b = first_se**-2, second_se**-2
    return (a * first + b * second) / (a + b), (a + b) ** -0.5
