"""Fair sharing of the workers between running jobs: the job that used less worker time recently goes first.

Decay-usage scheduling (J. Kay and P. Lauder, A Fair Share Scheduler, Communications of the ACM 31(1), 1988): each job
sums the worker time of its tasks, with exponential decay, and gives its next task a priority that falls with this sum.
Priorities are compared in the queues of the workers, so no server has to tell a job how many others there are. Each job
publishes its level in the scheduler's metadata, and a new job begins at the lowest published level, because otherwise
it would have the workers alone until its use had caught up. A job that is alone gets all workers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

DECAY_S = 120.0
"""Time constant of the decay, in seconds: use from this long ago counts 1/e. It is long against a block, because
otherwise the shares would depend on the duration of the fits' blocks: a replay of two fits on two workers with blocks
of 10 and 30 s gave 58 and 42 % with it, and 61 and 39 % with half of it. It is short against a fit, because otherwise a
fit that was idle for a while would have the workers alone for long afterwards."""
LEVELS_KEY = "dentine-shares"
"""Key of the fits' levels in the scheduler's metadata."""
PUBLISH_INTERVAL_S = 5.0
"""Shortest time between two publications of a fit's level, in seconds."""


class Share:
    """Worker time that one fit has used recently.

    Args:
        weight: the fit's share relative to other fits'.
        clock: returns a monotonic time in seconds.
    """

    def __init__(self, weight: float = 1.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._weight, self._clock = weight, clock
        self._used_s, self._decayed_to_s = 0.0, clock()
        self._total_s, self._tasks, self._pending = 0.0, 0, 0

    def begin(self) -> float:
        """Priority of a task that is about to be submitted; higher priorities run first. Pending tasks count with the
        mean time of the finished ones.
        """
        self._decay()
        expected_s = self._pending * self._total_s / self._tasks if self._tasks else 0.0
        self._pending += 1
        return -(self._used_s + expected_s) / self._weight

    def end(self, seconds: float, tasks: int = 1) -> None:
        """Count the worker time of tasks that have ended."""
        self._decay()
        self._used_s += seconds
        self._total_s, self._tasks, self._pending = self._total_s + seconds, self._tasks + tasks, self._pending - tasks

    @property
    def level(self) -> float:
        """Worker time used recently, in seconds per weight; fits of equal level take turns."""
        self._decay()
        return self._used_s / self._weight

    def begin_at(self, level: float) -> None:
        """Set the level, in seconds per weight."""
        self._decay()
        self._used_s = level * self._weight

    def _decay(self) -> None:
        now_s = self._clock()
        self._used_s *= math.exp((self._decayed_to_s - now_s) / DECAY_S)
        self._decayed_to_s = now_s


class PublishedLevels:
    """Levels of the fits on one scheduler, published in its metadata.

    Args:
        client: connection to the scheduler.
        name: name of this fit.
        share: the worker time that this fit has used.
        clock: returns the seconds since the epoch.
    """

    def __init__(self, client: Any, name: str, share: Share, clock: Callable[[], float] = time.time) -> None:
        self._client, self._name, self._share, self._clock = client, name, share, clock
        self._published_s = 0.0

    def join(self) -> None:
        """Set this fit's level to the lowest level of the running fits, decayed to the present."""
        now_s = self._clock()
        published: dict[str, tuple[float, float] | None] = self._client.get_metadata([LEVELS_KEY], default={})
        levels = [
            one[0] * math.exp((one[1] - now_s) / DECAY_S)
            for one in published.values()
            if one is not None and one[1] > now_s - DECAY_S
        ]
        self._share.begin_at(min(levels, default=0.0))
        self.publish()

    def publish(self) -> None:
        """Publish this fit's level, at most once in ``PUBLISH_INTERVAL_S`` seconds."""
        if self._clock() >= self._published_s + PUBLISH_INTERVAL_S:
            self._published_s = self._clock()
            self._client.set_metadata([LEVELS_KEY, self._name], (self._share.level, self._published_s))

    def leave(self) -> None:
        """Withdraw this fit's level; a scheduler that is gone is no error."""
        with suppress(OSError, TimeoutError):
            self._client.set_metadata([LEVELS_KEY, self._name], None)
