"""An executor of this process that claims the threads of a cluster, and records the names of its tasks."""

from __future__ import annotations

from typing import Any

from services.tasks.engine_host import InProcessHost
from services.tasks.executors import LocalExecutor


class RecordingExecutor(LocalExecutor):
    """``ran`` has the names of the tasks, in their order."""

    def __init__(self, threads: int) -> None:
        super().__init__(InProcessHost())
        self.ran: list[str] = []
        self._threads = threads

    def threads(self, expected: int = 1) -> int:
        return self._threads * expected

    def submit(self, key: str, task: Any, *args: Any) -> Any:
        self.ran.append(key)
        return super().submit(key, task, *args)
