"""How running fits share the workers: whoever has used less of them lately goes first.

Decay-usage scheduling (J. Kay and P. Lauder, A Fair Share Scheduler, Communications of the ACM 31(1), 1988): each fit counts the
worker time that its tasks took, old use fading away, and gives its next task a priority that is the lower the more it used.
Fits know nothing of each other, and no server has to tell them: priorities meet in the queues of the workers. A fit that is
alone gets everything; one that comes late goes first until it has had its share of the last two minutes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

FADING_S = 120.0
"""Use from so long ago counts 1/e. Long against a block, or shares would follow who has the longer blocks: a replay of two fits
on two workers with blocks of 10 and 30 s gave 58 and 42 % with it, and 61 and 39 % with half of it. Short against a fit, or a
newcomer would have the workers alone for long: for 80 s beside one fit that had them alone."""


class Share:
    """The worker time that one fit has used lately.

    Args:
        weight: its share relative to other fits'.
    """

    def __init__(self, weight: float = 1.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._weight, self._clock = weight, clock
        self._used_s, self._faded_to_s = 0.0, clock()
        self._total_s, self._tasks, self._pending = 0.0, 0, 0

    def begin(self) -> float:
        """The priority of a task that is about to be submitted; higher ones go first."""
        self._fade()
        expected_s = self._pending * self._total_s / self._tasks if self._tasks else 0.0
        self._pending += 1
        return -(self._used_s + expected_s) / self._weight

    def end(self, seconds: float, tasks: int = 1) -> None:
        """Count the worker time of tasks that have ended."""
        self._fade()
        self._used_s += seconds
        self._total_s, self._tasks, self._pending = self._total_s + seconds, self._tasks + tasks, self._pending - tasks

    def _fade(self) -> None:
        now_s = self._clock()
        self._used_s *= math.exp((self._faded_to_s - now_s) / FADING_S)
        self._faded_to_s = now_s
