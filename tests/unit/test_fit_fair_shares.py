"""Fits that share workers get equal worker time, or shares by weight, however long their blocks are."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import Any

import pytest

from services.tasks.fair_shares import DECAY_S, LEVELS_KEY, PUBLISH_INTERVAL_S, PublishedLevels, Share

WORKERS, AHEAD, BLOCKS, PAUSE_S = 2, 4, 12, 0.5


class Replay:
    """Simulates fits on workers in simulated time: a fit has steps, a step has blocks, and a worker takes the ready
    block with the highest priority.
    """

    def __init__(self, block_s: Sequence[float], weights: Sequence[float]) -> None:
        self.now_s, self._free, self._ready, self._events = (
            0.0,
            WORKERS,
            list[tuple[float, int, int]](),
            list[tuple[float, int, int]](),
        )
        self._block_s, self._order = block_s, 0
        self._shares = [Share(weight, lambda: self.now_s) for weight in weights]
        self._left, self._flying = [BLOCKS for _ in block_s], [0 for _ in block_s]
        self.used_s = [0.0 for _ in block_s]

    def run(self, until_s: float) -> list[float]:
        """Each fit's share of the workers' time."""
        for fit in range(len(self._block_s)):
            self._fill(fit)
        while self.now_s < until_s:
            while self._free and self._ready:
                _, _, fit = heapq.heappop(self._ready)
                self._free -= 1
                self._at(self._block_s[fit], fit)
            self.now_s, _, fit = heapq.heappop(self._events)
            self._end(fit)
        return [used_s / sum(self.used_s) for used_s in self.used_s]

    def _end(self, fit: int) -> None:
        if not self._flying[fit] and not self._left[fit]:  # the pause between two steps is over
            self._left[fit] = BLOCKS
        else:
            self._free, self._flying[fit] = self._free + 1, self._flying[fit] - 1
            self._shares[fit].end(self._block_s[fit])
            self.used_s[fit] += self._block_s[fit]
        if self._flying[fit] or self._left[fit]:
            self._fill(fit)
        else:
            self._at(PAUSE_S, fit)

    def _fill(self, fit: int) -> None:
        while self._left[fit] and self._flying[fit] < AHEAD:
            self._left[fit], self._flying[fit] = self._left[fit] - 1, self._flying[fit] + 1
            heapq.heappush(self._ready, (-self._shares[fit].begin(), self._next(), fit))

    def _at(self, after_s: float, fit: int) -> None:
        heapq.heappush(self._events, (self.now_s + after_s, self._next(), fit))

    def _next(self) -> int:
        self._order += 1
        return self._order


@pytest.mark.parametrize("block_s", [(1.0, 1.0), (1.0, 3.0), (0.2, 0.6), (3.0, 9.0)])
def test_equal_fits_get_equal_shares_whoever_has_the_longer_blocks(block_s: tuple[float, float]) -> None:
    first, second = Replay(block_s, (1.0, 1.0)).run(1200.0)
    assert abs(first - second) < 0.1 * (first + second)  # half of the 20 % that are promised


def test_three_fits_share_by_their_weights() -> None:
    shares = Replay((1.0, 0.5, 1.0), (0.25, 1.0, 0.25)).run(1200.0)
    assert shares == pytest.approx([1 / 6, 4 / 6, 1 / 6], abs=0.06)


def test_use_fades_and_what_is_under_way_counts() -> None:
    now_s = 0.0
    share = Share(clock=lambda: now_s)
    assert [share.begin(), share.begin()] == [0, 0]  # nothing is known of how long its tasks take
    share.end(10.0)
    assert share.begin() == pytest.approx(-20.0)  # the time used, and as much again for the task that has not ended
    share.end(10.0, tasks=2)
    assert share.begin() == pytest.approx(-20.0)
    now_s = DECAY_S
    assert share.begin() == pytest.approx(-20.0 / 2.718281828 - 20.0 / 3)


class Metadata:
    """The metadata that a scheduler keeps for its clients."""

    def __init__(self) -> None:
        self.kept: dict[str, dict[str, Any]] = {}

    def get_metadata(self, keys: list[str], default: Any) -> Any:
        return self.kept.get(keys[0], default)

    def set_metadata(self, keys: list[str], value: Any) -> None:
        self.kept.setdefault(keys[0], {})[keys[1]] = value


def test_a_newcomer_begins_at_the_lowest_level_of_those_under_way() -> None:
    now_s, scheduler = 1000.0, Metadata()

    def joined(name: str, used_s: float = 0.0, weight: float = 1.0) -> tuple[PublishedLevels, Share]:
        share = Share(weight, lambda: now_s)
        board = PublishedLevels(scheduler, name, share, lambda: now_s)
        board.join()
        share.begin_at(used_s or share.level)
        return board, share

    first, _ = joined("first", used_s=60.0)
    now_s += PUBLISH_INTERVAL_S
    first.publish()
    _, heavy = joined("heavy", weight=4.0)
    assert heavy.level == pytest.approx(60.0 * 2.718281828 ** (-PUBLISH_INTERVAL_S / DECAY_S))
    now_s += PUBLISH_INTERVAL_S
    _, third = joined("third")
    assert third.level == pytest.approx(heavy.level)
    first.leave()
    assert scheduler.kept[LEVELS_KEY]["first"] is None
    now_s += DECAY_S
    _, late = joined("late")
    assert late.level == 0.0, "who has told nothing for so long is not under way"
