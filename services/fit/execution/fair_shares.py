"""How running fits share the workers: whoever has used less of them lately goes first.

Decay-usage scheduling (J. Kay and P. Lauder, A Fair Share Scheduler, Communications of the ACM 31(1), 1988): each fit
counts the worker time that its tasks took, old use fading away, and gives its next task a priority that is the lower
the more it used. Priorities meet in the queues of the workers; no server has to tell a fit how many others there are.
Each tells its level on the scheduler's board, and a newcomer begins at the lowest one there, or it would have the
workers alone until it had caught up. A fit that is alone gets everything.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

FADING_S = 120.0
"""Use from so long ago counts 1/e. Long against a block, or shares would follow who has the longer blocks: a replay of
two fits on two workers with blocks of 10 and 30 s gave 58 and 42 % with it, and 61 and 39 % with half of it. Short
against a fit, or one that had nothing to do for a while would have the workers alone for long afterwards."""
BOARD = "dentine-shares"
TELL_S = 5.0
"""How often a fit that is busy tells its level."""


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

    @property
    def level(self) -> float:
        """Worker time used lately, per weight; fits of one level take turns."""
        self._fade()
        return self._used_s / self._weight

    def begin_at(self, level: float) -> None:
        """Count as if this much had been used."""
        self._fade()
        self._used_s = level * self._weight

    def _fade(self) -> None:
        now_s = self._clock()
        self._used_s *= math.exp((self._faded_to_s - now_s) / FADING_S)
        self._faded_to_s = now_s


class Board:
    """What fits on one scheduler tell of their levels, in its metadata.

    Args:
        client: connection to the scheduler.
        name: of this fit.
    """

    def __init__(self, client: Any, name: str, share: Share, clock: Callable[[], float] = time.time) -> None:
        self._client, self._name, self._share, self._clock = client, name, share, clock
        self._told_s = 0.0

    def join(self) -> None:
        """Begin at the lowest level of those that are under way."""
        now_s = self._clock()
        told: dict[str, tuple[float, float] | None] = self._client.get_metadata([BOARD], default={})
        levels = [
            one[0] * math.exp((one[1] - now_s) / FADING_S)
            for one in told.values()
            if one is not None and one[1] > now_s - FADING_S
        ]
        self._share.begin_at(min(levels, default=0.0))
        self.tell()

    def tell(self) -> None:
        """Tell this fit's level, not too often."""
        if self._clock() >= self._told_s + TELL_S:
            self._told_s = self._clock()
            self._client.set_metadata([BOARD, self._name], (self._share.level, self._told_s))

    def leave(self) -> None:
        """Count no more; where the scheduler has gone away, nobody is left to count."""
        with suppress(OSError, TimeoutError):
            self._client.set_metadata([BOARD, self._name], None)
