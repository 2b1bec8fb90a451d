"""What the benchmarks of gradients share: an estimate with its noise and its price, and how it is written down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.bench import Row

Array = NDArray[np.float64]


class GradientRow(Row):
    """A row of the gradient to one parameter, or of all of them: then ``error`` is the geometric mean of theirs."""

    parameter: str | None = None
    samples: int | None = None
    """Paths per pixel and light of the peer's image and of its backward pass; of all our Jacobian passes together."""
    gradient: float | None = None
    """To the natural parameter; the row's ``error`` is relative to it."""
    z: float | None = None
    """In a peer's summary row: its gradient less ours under the same lights, in standard errors; in the one over all
    parameters the rms of theirs."""


@dataclass(frozen=True)
class Estimate:
    """A gradient (F,), the variance of a single such estimate, the variance of ``mean``, and the time a single one
    takes.
    """

    mean: Array
    variance: Array
    mean_variance: Array
    seconds: float


def of_parts(repeats: Array, seconds: float) -> Estimate:
    """From repeats of a sum over parts with random numbers of their own, (R, F, parts)."""
    variance = repeats.var(axis=0, ddof=1).sum(axis=-1)
    return Estimate(repeats.mean(axis=0).sum(axis=-1), variance, variance / len(repeats), seconds)
