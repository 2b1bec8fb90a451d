"""How a fit of any solver ended: the solution, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.normal_equations import NormalEquations

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
