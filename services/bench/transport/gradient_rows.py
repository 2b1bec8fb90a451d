"""Records that the benchmarks of gradients share: an estimate with its noise and its time, and its row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.bench import Row

Array = NDArray[np.float64]


class GradientRow(Row):
    """Row of the gradient with respect to one parameter, or over all parameters; then ``error`` is the geometric mean
    of theirs.
    """

    parameter: str | None = None
    """Name of the parameter; None in a row over all parameters."""
    samples: int | None = None
    """Paths per pixel and light of the peer's image and of its backward pass; for this engine paths per pixel of all
    Jacobian passes together."""
    gradient: float | None = None
    """Derivative with respect to the natural parameter; the row's ``error`` is relative to it."""
    z: float | None = None
    """In a peer's summary row its gradient minus this engine's under the same lights, in standard errors; in the row
    over all parameters the rms of these."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of a gradient.

    Attributes:
        mean: gradient (F,), the mean over repeats.
        variance: variance (F,) of a single repeat.
        mean_variance: variance (F,) of ``mean``.
        seconds: time of a single repeat.
    """

    mean: Array
    variance: Array
    mean_variance: Array
    seconds: float


def of_parts(repeats: Array, seconds: float) -> Estimate:
    """Return the estimate from repeats (R, F, parts) of a sum over parts that have independent random numbers."""
    variance = repeats.var(axis=0, ddof=1).sum(axis=-1)
    return Estimate(repeats.mean(axis=0).sum(axis=-1), variance, variance / len(repeats), seconds)
