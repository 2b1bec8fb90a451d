"""Handle of a rendering process: its memory use, and the reason why it ended."""

from __future__ import annotations

import signal
import subprocess
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil

from services.core.errors import CrashError, Evidence, MemoryKillError, ResourceError

OUT_OF_MEMORY_COUNTERS = (Path("/proc/vmstat"), Path("/sys/fs/cgroup/memory.events"))
"""Files in which the system counts the processes that it killed for lack of memory."""
REMEDY = "lower samples_per_pixel, raise pixel_step or give the worker more memory"


class EngineProcess:
    """A child process and the pipe to it.

    Args:
        process: the running child.
        pipe: this end of the pipe to the child.
        memory_bytes: largest resident memory of the child; None for no limit but the system's.
    """

    def __init__(self, process: subprocess.Popen[bytes], pipe: Connection[Any, Any], memory_bytes: int | None) -> None:
        self.pipe = pipe
        self._process, self._memory_bytes = process, memory_bytes
        self._kills_before, self._peak_bytes = memory_kills(), 0
        self.was_out_of_memory = False

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def check_memory(self) -> None:
        """Measure the resident memory of the process.

        Raises:
            MemoryKillError: it exceeds the limit; the caller has to end the process.
        """
        with suppress(psutil.NoSuchProcess):
            self._peak_bytes = max(self._peak_bytes, psutil.Process(self.pid).memory_info().rss)
        if self._memory_bytes is not None and self._peak_bytes > self._memory_bytes:
            share = f"{self._memory_bytes / 2**30:.1f} GiB"
            raise MemoryKillError(
                f"The rendering process grew beyond its {share} of memory and was ended; {REMEDY}.", self._evidence()
            )

    def end(self) -> None:
        """Kill the process if it still runs, and find out whether it died for lack of memory."""
        self.pipe.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        self._process.kill()
        self._process.wait()
        self.was_out_of_memory = self._process.returncode == -signal.SIGKILL and memory_kills() > self._kills_before

    def exit_error(self) -> ResourceError:
        """The error that says how the process ended."""
        status, evidence = self._process.returncode, self._evidence()
        if self.was_out_of_memory:
            return MemoryKillError(f"The system killed the rendering process for lack of memory; {REMEDY}.", evidence)
        how = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        return CrashError(
            f"The rendering process {how} twice in one task; look for its last words in the worker's log.", evidence
        )

    def _evidence(self) -> Evidence:
        return {
            "exit_status": self._process.returncode,
            "peak_memory_bytes": self._peak_bytes,
            "memory_limit_bytes": self._memory_bytes,
        }


def memory_kills() -> int:
    """Number of processes that the system has killed for lack of memory."""
    total = 0
    for path in OUT_OF_MEMORY_COUNTERS:
        with suppress(OSError):
            total += sum(int(line.split()[1]) for line in path.read_text().splitlines() if line.startswith("oom_kill "))
    return total
