"""Shows a job's events in a terminal: bars where there is one, plain lines elsewhere. Always on standard error."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from services.api.events import JobEvent

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class ProgressView:
    """A context manager that is called with every event; ``events`` counts them."""

    def __init__(self) -> None:
        self.events = 0
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
                TextColumn("{task.fields[note]}"),
            )
            self._bars = Progress(*columns, console=Console(stderr=True))
            self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, event: JobEvent) -> None:
        """Show one event."""
        self.events += 1
        if self._bars is not None:
            self._draw(self._bars, event)
        elif self._worth_a_line(event):
            share = f" {100 * event.done:3.0f} %" if event.done is not None else ""
            print(f"{event.stage or 'job'}{share}: {_note(event) or event.kind}", file=sys.stderr, flush=True)

    def _draw(self, bars: Progress, event: JobEvent) -> None:
        if event.stage is None:
            return
        if event.stage not in self._tasks:
            self._tasks[event.stage] = bars.add_task(event.stage, total=1.0, note="")
        task = self._tasks[event.stage]
        bars.update(task, completed=event.done)
        if note := _note(event):
            bars.update(task, note=note)
        if event.kind == "finished":
            bars.stop_task(task)

    def _worth_a_line(self, event: JobEvent) -> bool:
        """Every event but previews, and progress only when it enters another tenth."""
        if event.kind != "progress" or event.done is None or event.stage is None:
            return event.kind != "preview"
        tenth = int(10 * event.done)
        fresh = self._tenths.get(event.stage) != tenth
        self._tenths[event.stage] = tenth
        return fresh


def _note(event: JobEvent) -> str:
    held_out = event.data.get("held_out_error") if event.kind == "step" else None
    return f"{event.message.rstrip('.')}; held-out error {100 * held_out:.1f} %." if isinstance(held_out, float) else event.message
