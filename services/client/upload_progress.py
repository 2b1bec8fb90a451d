"""Show the progress of an upload on standard error: as a bar in a terminal, as one line per tenth elsewhere."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from services.client.uploader import UploadProgress

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class UploadView:
    """A context manager that is called with every ``UploadProgress``."""

    def __init__(self) -> None:
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._last_printed: tuple[str, int] | None = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                DownloadColumn,
                Progress,
                TextColumn,
                TimeRemainingColumn,
                TransferSpeedColumn,
            )

            columns = (
                TextColumn("{task.description:<8}"),
                BarColumn(),
                DownloadColumn(),
                TransferSpeedColumn(),
                TimeRemainingColumn(),
            )
            self._bars = Progress(*columns, TextColumn("{task.fields[path]}"), console=Console(stderr=True))
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, progress: UploadProgress) -> None:
        """Show the progress."""
        if self._bars is not None:
            if progress.phase not in self._tasks:
                self._tasks[progress.phase] = self._bars.add_task(progress.phase, total=progress.total_bytes, path="")
            self._bars.update(self._tasks[progress.phase], completed=progress.done_bytes, path=progress.path)
            return
        share = progress.done_bytes / max(progress.total_bytes, 1)
        if self._last_printed != (tenth := (progress.phase, int(10 * share))):
            self._last_printed = tenth
            print(f"{progress.phase} {100 * share:3.0f} %: {progress.path}", file=sys.stderr, flush=True)
