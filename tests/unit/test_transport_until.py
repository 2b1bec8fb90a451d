"""Rounds of a walk until an error is reached: each goes on where the last one ended, grows within bounds, and the walk
stops at that error.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.transport.paths.until import FIRST_ROUND, GROWTH, MIN_GROWTH, Effort, trace_until
from services.transport.scene.recipe import StackEstimate, relative_error

PIXELS = 400


class Walk:
    """Pixels of brightness 1; each pixel's paths have their own standard deviation."""

    def __init__(self, spread: float) -> None:
        self.spread, self.rounds, self.random = spread, list[range](), np.random.default_rng(1)

    def trace(self, numbers: range, batches: int) -> list[NDArray[np.float64]]:
        self.rounds.append(numbers)
        count = len(numbers)
        return [self.random.normal(count, self.spread * np.sqrt(count), (batches, PIXELS, 1))]

    def until(self, effort: Effort) -> StackEstimate:
        return trace_until(
            self.trace,
            lambda tables: StackEstimate(tables[0].mean(axis=0).T, tables[0].var(axis=0, ddof=1).T / len(tables[0])),
            effort,
        )


def test_rounds_follow_on_and_grow_within_bounds() -> None:
    walk = Walk(spread=10)
    found = walk.until(Effort(rel_error=0.05))
    assert found.complete
    assert walk.rounds[0] == range(FIRST_ROUND)
    for last, following in zip(walk.rounds, walk.rounds[1:], strict=False):
        assert following.start == last.stop
        assert MIN_GROWTH <= following.stop / last.stop <= GROWTH
    # An error of 5 % needs 200^2 paths; it is known to 2 % from 6000 degrees of freedom, and the last round has a
    # margin of 5 to 25 %.
    assert found.samples == 16 * walk.rounds[-1].stop
    assert 0.95 * 200**2 <= found.samples <= 1.35 * 200**2
    assert abs(found.mean.mean() - 1) <= 4.5 * 0.05 / np.sqrt(PIXELS)


def test_an_easy_error_takes_one_round() -> None:
    walk = Walk(spread=0.01)
    assert walk.until(Effort(rel_error=0.01)).complete
    assert walk.rounds == [range(FIRST_ROUND)]


@pytest.mark.parametrize("most", [16, 100, 1000, 1007])
def test_limits_are_kept_exactly(most: int) -> None:
    walk = Walk(spread=10)
    found = walk.until(Effort(rel_error=0.001, max_samples=most))
    assert not found.complete
    assert found.samples == most // 16 * 16


@pytest.mark.parametrize(("samples", "rounds"), [(7, range(1)), (16, range(1)), (17, range(2)), (160, range(10))])
def test_a_number_of_paths_is_one_round(samples: int, rounds: range) -> None:
    walk = Walk(spread=1)
    assert walk.until(Effort(samples=samples)).samples == len(rounds) * min(16, samples)
    assert walk.rounds == [rounds]


def test_relative_errors_of_the_dark() -> None:
    nothing = np.zeros((2, 3))
    assert relative_error(nothing, nothing) == 0
    assert relative_error(nothing, nothing + 1) == np.inf
    assert relative_error(np.full((2, 3), 2.0), np.full((2, 3), 0.01)) == pytest.approx(0.05)
