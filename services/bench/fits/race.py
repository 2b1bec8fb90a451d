"""Decisions of a race of fits: when a solver has reached a level of error, and which of two was there first.

A level is an error that a solver is held to. It counts as reached when it is kept to the end of the run. An error that
is measured has a standard error, so the time of reaching lies in a span: ``after_s`` is the last time at which the
error was surely above the level, ``by_s`` the first time from which on it was surely below. Where spans of two solvers
overlap, or where the photographs themselves allow no such error, the race decides nothing and says why.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

SURE_Z = 2.0
"""Standard errors by which a measured error lies above or below a level to be surely there."""
MAX_KNOWN_SHARE = 1 / 3
"""Largest standard error of an error, and largest floor of the photographs, as a share of the level."""
KEPT_SHARE = 0.2
"""Last share of a run through which a solver without an end of its own has to keep a level: noise alone takes it below
some level at its very last iterate."""


@dataclass(frozen=True)
class Measured:
    """Relative error of an iterate after so many seconds of processor time."""

    seconds: float
    error: float
    se: float = 0.0
    """Standard error of ``error``; 0 where it follows from the iterate's own parameters and the truth."""

    def is_above(self, level: float) -> bool:
        """Whether the error is surely above the level."""
        return self.error - SURE_Z * self.se > level

    def is_below(self, level: float) -> bool:
        """Whether the error is surely not above the level."""
        return self.se <= MAX_KNOWN_SHARE * level and self.error + SURE_Z * self.se <= level


@dataclass(frozen=True)
class Span:
    """When a solver reached a level."""

    after_s: float
    """Last time at which it was surely not there; 0 if it was there from the first iterate."""
    by_s: float | None
    """First time from which on it surely was; None where it did not get there, or not surely."""


def time_to(level: float, run: Sequence[Measured], *, has_ended: bool) -> Span:
    """Return when a run reached a level and kept it.

    Args:
        level: relative error.
        run: errors of its iterates in the order of time, at least one.
        has_ended: whether the solver ended by itself; a run that was stopped must keep the level through the last
            ``KEPT_SHARE`` of its time.
    """
    above = [one.seconds for one in run if one.is_above(level)]
    not_below = [k for k, one in enumerate(run) if not one.is_below(level)]
    first = not_below[-1] + 1 if not_below else 0
    by_s = run[first].seconds if first < len(run) else None
    if by_s is not None and not has_ended and by_s > (1 - KEPT_SHARE) * run[-1].seconds:
        by_s = None
    return Span(above[-1] if above else 0.0, by_s)


def best(spans: Iterable[Span]) -> Span:
    """Return the span of a solver that ran several times with different settings: to its favour the earliest times."""
    known = list(spans)
    reached = [one.by_s for one in known if one.by_s is not None]
    return Span(min(one.after_s for one in known), min(reached, default=None))


@dataclass(frozen=True)
class Verdict:
    """Which of two solvers reached a level first."""

    lowest: float | None
    """Smallest ratio of the other's time to ours; None where the race decides nothing."""
    highest: float | None
    """Largest ratio; None where there is no upper bound, as the other did not reach the level."""
    sentence: str

    @property
    def is_decided(self) -> bool:
        """Whether one of the two was surely first."""
        return self.lowest is not None


def floor_sentence(level: float, floor: float) -> str:
    """Return why a level is too near to the floor that the photographs set; empty where it is not."""
    if floor <= MAX_KNOWN_SHARE * level:
        return ""
    return (
        f"decides nothing: the photographs allow an error of {100 * floor:.2g} % (one standard deviation) to the best"
        f" fit, and a level of {100 * level:g} % needs a third of that level"
    )


def verdict(level: float, floor: float, ours: Span, other: Span) -> Verdict:
    """Compare the times at which two solvers reached a level.

    Args:
        level: relative error.
        floor: standard deviation of the error of the best fit, by the photographs' noise.
        ours, other: when this project's fit and the other solver reached the level.
    """
    if near := floor_sentence(level, floor):
        return Verdict(None, None, near)
    if ours.by_s is None and other.by_s is None:
        return Verdict(None, None, "decides nothing: neither surely reached the level and kept it")
    if ours.by_s is not None and other.after_s > ours.by_s:
        lowest = other.after_s / ours.by_s
        if other.by_s is None:
            return Verdict(lowest, None, f"dentine is over {lowest:.3g} times as fast")
        highest = other.by_s / ours.after_s if ours.after_s > 0 else None
        told = f"at least {lowest:.3g}" if highest is None else f"{lowest:.3g} to {highest:.3g}"
        return Verdict(lowest, highest, f"dentine is {told} times as fast")
    if other.by_s is not None and ours.after_s > other.by_s:
        lowest = 0.0 if ours.by_s is None else other.after_s / ours.by_s
        highest = other.by_s / ours.after_s
        return Verdict(lowest, highest, f"the other is at least {1 / highest:.3g} times as fast")
    return Verdict(None, None, f"decides nothing: {_undecided(ours, other)}")


def _undecided(ours: Span, other: Span) -> str:
    if ours.by_s is None:
        return "dentine did not surely reach the level"
    if other.by_s is None:
        return "the other was stopped, or not surely above the level, before dentine had surely reached it"
    return "the times at which both reached the level overlap"
