"""What a fit knows after its final uncertainty estimate: the sums of that estimate, and the step that followed."""

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
    step: Array
    """The step (F,) from x that followed."""
    remaining: float
    """Share of the step that remains after it that may be true: less than 1 where comparisons refuted the whole."""
    sources: tuple[str, ...]
    """Kind of each of the last changes in ``sums`` (``covariance.uncertainty``)."""

    def record(self) -> dict[str, Any]:
        """The estimate as JSON values."""
        own = {"step": self.step.tolist(), "remaining": self.remaining, "sources": list(self.sources)}
        return {"sums": self.sums.record()} | own

    @staticmethod
    def of(record: dict[str, Any]) -> Closing:
        """The estimate of a record."""
        step, remaining = np.array(record["step"], dtype=np.float64), float(record["remaining"])
        return Closing(FinalSums.of(record["sums"]), step, remaining, tuple(record["sources"]))

    def uncertainty(self, domain: Domain, x: Array, equations: NormalEquations, part_count: int) -> Uncertainty:
        """The uncertainty after the step from x, the point of this estimate, whose equations these are."""
        measured = self.sums, self.step, self.sources
        return uncertainty(domain, x + self.step, equations, *measured, part_count, self.remaining)
