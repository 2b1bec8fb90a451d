"""How often a dome may flash. A flash is one time that light goes on.

Three to 65 flashes a second can trigger epileptic seizures. So light goes on at most three times in any second, unless
a person has acknowledged a higher rate. Flashes are evenly spaced, because a short burst has a high rate of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from time import monotonic

from services.core.light.safety import FREE_FLASHES_PER_S, FlashAcknowledgement

REST_S = 1.0
"""Time in s for which a driver leaves a dome dark before its first light. The flashes of drivers that follow each other
then do not add up."""
MARGIN = 0.01
"""Part by which an interval between flashes is longer than the rate asks, so that a controller whose delay varies by
milliseconds keeps the rate too."""


def utc_now() -> datetime:
    """The present time."""
    return datetime.now(UTC)


class Flashes:
    """The flashes of one driver, and the time at which the next one may come.

    Args:
        acknowledged: what a person has acknowledged; None for the rate that needs no acknowledgement.
        clock: returns the time in s; it need not be that of a calendar.
        now: returns the time of the calendar, by which the acknowledgement's age is judged.
        before_first: called once before the first flash under an acknowledgement, such as to record it.
    """

    def __init__(
        self,
        acknowledged: FlashAcknowledgement | None = None,
        *,
        clock: Callable[[], float] | None = None,
        now: Callable[[], datetime] = utc_now,
        before_first: Callable[[FlashAcknowledgement], None] = lambda _: None,
    ) -> None:
        self._acknowledged, self._clock, self._now = acknowledged, clock or monotonic, now
        self._before_first, self._has_flashed = before_first, False
        per_s = FREE_FLASHES_PER_S if acknowledged is None else acknowledged.per_s
        self.interval_s = (1 + MARGIN) / per_s
        """Shortest time in s between two flashes."""
        self.rest_s = REST_S
        """Time in s from the driver's start to its first flash."""
        self._due_s = self._clock() + self.rest_s

    @classmethod
    def of_no_real_light(cls) -> Flashes:
        """The flashes of a simulated dome, which nobody sees: no limit."""
        unlimited = cls()
        unlimited.interval_s = unlimited.rest_s = 0.0
        unlimited.begin()
        return unlimited

    def begin(self) -> None:
        """Begin the rest before the first flash; the driver has just seen the dome dark."""
        self._due_s = self._clock() + self.rest_s

    def wait_s(self) -> float:
        """Time in s until light may go on; 0 where it may go on now."""
        return max(self._due_s - self._clock(), 0.0)

    def require_allowed(self) -> None:
        """Check, before the first flash, that the acknowledgement holds.

        Raises:
            SettingsError: it is too old.
        """
        if self._acknowledged is not None and not self._has_flashed:
            self._acknowledged.require_recent(self._now())
            self._before_first(self._acknowledged)
            self._has_flashed = True

    def count(self) -> None:
        """Count a flash. Call it after the order of light, so that the light went on at this time or before."""
        self._due_s = self._clock() + self.interval_s
