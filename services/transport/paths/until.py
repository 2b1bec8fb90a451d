"""Number of paths to trace: a fixed number, or rounds of growing size until the estimated error is as small as
requested.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError
from services.transport.scene.recipe import JacobianEstimate, StackEstimate

FIRST_ROUND = 4
"""Paths per batch in the first round."""
GROWTH = 4.0
"""Largest growth of the number of all paths in one round, because an early estimate of the error is not trusted
further."""
MIN_GROWTH = 1.25
"""Smallest growth of that number, because every look at the error is a chance to stop on one that is too small by
luck."""
SAFETY = 1.05
"""Factor by which a round exceeds the number of paths that the error so far calls for."""
MAX_SAMPLES = 2**31
"""Largest number of paths per pixel; sample numbers of 32 bits tell them apart, with room to spare."""

Sums = list[NDArray[np.float64]]
"""Sums over paths for each table, (batches, N, slots)."""
Estimate = TypeVar("Estimate", StackEstimate, JacobianEstimate)


@dataclass(frozen=True)
class Effort:
    """The effort that a caller requests: either ``samples`` paths per pixel, or ``rel_error`` within the limits.

    Raises:
        InputError: both or neither is given, or a number is out of its range.
    """

    samples: int | None = None
    rel_error: float | None = None
    max_seconds: float = math.inf
    max_samples: int = MAX_SAMPLES
    batches: int = 16

    def __post_init__(self) -> None:
        if (self.samples is None) == (self.rel_error is None):
            raise InputError(
                f"samples = {self.samples} and rel_error = {self.rel_error}: give exactly one, a number of paths per"
                " pixel or an error to reach."
            )
        if self.samples is not None and (self.samples < 1 or self.batches < 1):
            raise InputError(
                f"samples = {self.samples} and batches = {self.batches} must be at least 1; ask for one path per pixel"
                " or more."
            )
        if self.rel_error is None:
            return
        if not 0 < self.rel_error < 1:
            raise InputError(f"rel_error = {self.rel_error:g} must lie between 0 and 1; 0.01 is usual.")
        if self.batches < 2:
            raise InputError(
                f"batches = {self.batches} must be at least 2 with rel_error, as the error is the spread between"
                " batches."
            )
        if not self.max_seconds >= 0 or not self.batches <= self.max_samples <= MAX_SAMPLES:
            raise InputError(
                f"max_seconds = {self.max_seconds:g} must not be negative, and max_samples = {self.max_samples} must"
                f" lie in batches = {self.batches} to {MAX_SAMPLES}; correct the limits."
            )

    def shares(self, samples: int) -> tuple[int, int]:
        """Number of batches, and of samples in each, that make up ``samples`` paths per pixel."""
        batches = min(self.batches, samples)
        return batches, -(-samples // batches)


def trace_until(trace: Callable[[range, int], Sums], summarise: Callable[[Sums], Estimate], effort: Effort) -> Estimate:
    """Trace rounds with consecutive sample numbers, and summarise all of them together.

    Every batch has an equal share of every round, so errors have one degree of freedom less than there are batches,
    however many rounds were needed.

    Args:
        trace: gives the sums over the sample numbers in a range, in each of a number of batches.
        summarise: makes the estimate from means per path.
    """
    if effort.samples is not None:
        batches, count = effort.shares(effort.samples)
        return _summary(summarise, trace(range(count), batches), count, batches, complete=True)

    assert effort.rel_error is not None
    batches, most, begun_s = effort.batches, effort.max_samples // effort.batches, time.monotonic()
    done, round_size = 0, min(FIRST_ROUND, most)
    totals: Sums = []
    while True:
        sums = trace(range(done, done + round_size), batches)
        totals = [total + new for total, new in zip(totals, sums, strict=True)] if totals else sums
        done += round_size
        estimate = _summary(summarise, totals, done, batches, complete=False)
        missing = (estimate.rel_error / effort.rel_error) ** 2
        if missing <= 1:
            return replace(estimate, complete=True)
        # Trace as many paths as the error asks for, but no round far beyond the time that is left.
        elapsed_s = time.monotonic() - begun_s
        if done >= most or elapsed_s >= effort.max_seconds:
            return estimate
        required = done * (np.clip(SAFETY * missing, MIN_GROWTH, GROWTH) - 1)
        affordable = done * (effort.max_seconds - elapsed_s) / elapsed_s
        round_size = max(1, min(math.ceil(min(required, affordable)), most - done))


def _summary(
    summarise: Callable[[Sums], Estimate], totals: Sums, count: int, batches: int, *, complete: bool
) -> Estimate:
    return replace(summarise([total / count for total in totals]), samples=count * batches, complete=complete)
