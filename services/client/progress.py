"""Show a job's events on standard error: as bars in a terminal, as plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from services.core.events import JobEvent

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

REMAINING_INTERVAL_S = 5.0
"""Interval, s, at which the range of the remaining time is requested; 12 times as long where lines are printed."""


class ProgressView:
    """A context manager that is called with every event; ``events`` counts them.

    Args:
        remaining: returns the remaining time of the job, as ``remaining`` of a job in the API.
    """

    def __init__(self, remaining: Callable[[], dict[str, Any] | None] | None = None) -> None:
        self.events = 0
        self._remaining, self._requested_s, self._last_text = remaining, 0.0, ""
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._tenths: dict[str, int] = {}

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (
                TextColumn("{task.description:<8}"),
                BarColumn(),
                TextColumn("{task.percentage:3.0f} %"),
                TimeElapsedColumn(),
                TextColumn("{task.fields[left]}"),
                TextColumn("{task.fields[note]}"),
            )
            self._bars = Progress(*columns, console=Console(stderr=True))
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, event: JobEvent) -> None:
        """Show one event."""
        self.events += 1
        if self._bars is not None:
            self._draw(self._bars, event)
        elif self._is_printed(event):
            share = f" {100 * event.done:3.0f} %" if event.done is not None else ""
            print(f"{event.stage or 'job'}{share}: {_note(event) or event.kind}", file=sys.stderr, flush=True)
        if self._remaining is not None and self._is_remaining_due(event):
            self._show_remaining(describe(self._remaining()), event)

    def _is_remaining_due(self, event: JobEvent) -> bool:
        now_s, pause_s = time.monotonic(), REMAINING_INTERVAL_S if self._bars is not None else 12 * REMAINING_INTERVAL_S
        if event.kind not in {"state", "started"} and now_s < self._requested_s + pause_s:
            return False
        self._requested_s = now_s
        return True

    def _show_remaining(self, text: str, event: JobEvent) -> None:
        if self._bars is not None:
            for stage, task in self._tasks.items():
                self._bars.update(task, left=text if stage == event.stage else "")
        elif text and text != self._last_text:
            print(f"job: {text}", file=sys.stderr, flush=True)
        self._last_text = text

    def _draw(self, bars: Progress, event: JobEvent) -> None:
        if event.stage is None:
            return
        if event.stage not in self._tasks:
            self._tasks[event.stage] = bars.add_task(event.stage, total=1.0, note="", left="")
        task = self._tasks[event.stage]
        bars.update(task, completed=event.done)
        if note := _note(event):
            bars.update(task, note=note)
        if event.kind == "finished":
            bars.stop_task(task)
            bars.update(task, left="")

    def _is_printed(self, event: JobEvent) -> bool:
        """Whether to print the event: all but previews, and progress only where it enters another tenth."""
        if event.kind != "progress" or event.done is None or event.stage is None:
            return event.kind != "preview"
        tenth = int(10 * event.done)
        is_new = self._tenths.get(event.stage) != tenth
        self._tenths[event.stage] = tenth
        return is_new


def _note(event: JobEvent) -> str:
    held_out, se = event.data.get("held_out_error"), event.data.get("held_out_se")
    if event.kind != "step" or not isinstance(held_out, float):
        return event.message
    if isinstance(se, float) and se >= held_out:
        return f"{event.message.rstrip('.')}; held-out error not yet told from the renders' noise."
    spread = f" ± {100 * se:.1f}" if isinstance(se, float) else ""
    return f"{event.message.rstrip('.')}; held-out error {100 * held_out:.1f}{spread} %."


def describe(remaining: dict[str, Any] | None) -> str:
    """The range of the remaining time in a few words, or why there is none; empty once the job has ended."""
    if remaining is None:
        return ""
    if remaining["low_s"] is None or remaining["high_s"] is None:
        return f"no time range: {remaining['reason']}"
    return (
        f"ends in {range_text(remaining['low_s'], remaining['high_s'])} (80 % range from {remaining['past_jobs']} past"
        " jobs)"
    )


def range_text(low_s: float, high_s: float) -> str:
    """A range between two durations, with as many digits as are significant."""
    (low, low_unit), (high, high_unit) = _duration(low_s), _duration(high_s)
    return f"{low} to {high} {high_unit}" if low_unit == high_unit else f"{low} {low_unit} to {high} {high_unit}"


def _duration(seconds: float) -> tuple[str, str]:
    value, unit = (seconds, "s") if seconds < 90 else (seconds / 60, "min") if seconds < 5400 else (seconds / 3600, "h")
    return f"{value:.1f}" if value < 9.95 and unit != "s" else f"{value:.0f}", unit
