"""What a fit knows after its final uncertainty estimate: the sums of that estimate, and the step that follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain
from services.fit.solve.covariance import Uncertainty, uncertainty
from services.fit.solve.final_uncertainty import FinalSums
from services.fit.solve.normal_equations import NormalEquations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Closing:
    """A final uncertainty estimate at one x, in coordinates that the equations there whiten."""

    sums: FinalSums
    sources: tuple[str, ...]
    """Kind of each of the last changes in ``sums`` (``covariance.uncertainty``)."""
    step: Array
    """The step (F,) from x that follows; zeros before it is made."""
    remaining: float = 0.0
    """Share of the step that remains after it that may be true: less than 1 where comparisons refuted the whole, and 0
    before the step is made."""

    def record(self) -> dict[str, Any]:
        """The estimate without its step as JSON values."""
        return {"sums": self.sums.record(), "sources": list(self.sources)}

    @staticmethod
    def of(record: dict[str, Any]) -> Closing:
        """The estimate of a record, without a step."""
        sums = FinalSums.of(record["sums"])
        return Closing(sums, tuple(record["sources"]), np.zeros(len(sums.gradient)))

    def uncertainty(self, domain: Domain, x: Array, equations: NormalEquations, part_count: int) -> Uncertainty:
        """The uncertainty after the step from x, the point of this estimate, whose equations these are."""
        measured = self.sums, self.step, self.sources
        return uncertainty(domain, x + self.step, equations, *measured, part_count, self.remaining)
