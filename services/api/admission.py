"""Which jobs may start: those whose predicted disk is free. What disk or memory the machine does not have in all is refused when a job is submitted."""

from __future__ import annotations

import itertools
import shutil
import stat
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from services.core.errors import DentineError, DiskFullError, JobTooLargeError, StoreError
from services.core.records import JobSpec
from services.core.store import MANIFEST

DISK_PER_CAPTURE = 6.0
"""Bytes that a job stores per byte of its capture: the demo's stores 4.8 MB of 0.85 MB, of which compressed images are most."""
LEAST_DISK_BYTES = 64 * 2**20
"""What a job stores of a small capture: pictures, checkpoint and asset."""
RIG_CAPTURE_BYTES = 2 * 2**30
"""A capture that a rig is about to take."""
WORKER_BYTES = 3 * 2**29
"""Memory of one worker and its rendering process in a jaw's fit; 1.1 GiB were measured."""
MOST_FILES = 5_000
"""Of a capture that are looked at."""
_DESCRIPTIONS = ("capture.json", MANIFEST, f"capture/{MANIFEST}")
"""One of these makes a folder a capture, or a job that holds one."""
KEPT_FREE_BYTES = 256 * 2**20
"""Disk that no job may count on."""
RETRY_S = 10.0
"""How long a job waits after it was paused."""


@dataclass(frozen=True)
class Needs:
    """What a job is predicted to take."""

    disk_bytes: int
    memory_bytes: int


def predict(spec: JobSpec) -> Needs:
    """Prediction from the size of the capture and the number of workers."""
    size = RIG_CAPTURE_BYTES if spec.capture is None else _stored_bytes(spec.capture)
    return Needs(LEAST_DISK_BYTES + round(DISK_PER_CAPTURE * size), WORKER_BYTES * spec.workers)


def _stored_bytes(folder: Path) -> int:
    # What lies on the disk, of as many files as a capture may have. What is no capture, such as '/', is refused by its stage and not walked through here. Nor
    # does a folder that cannot be listed, as on a mount that went away, keep other jobs from starting.
    total = 0
    with suppress(OSError):
        if not any((folder / one).is_file() for one in _DESCRIPTIONS):
            return 0
        for path in itertools.islice(folder.rglob("*"), MOST_FILES):
            with suppress(OSError):
                status = path.lstat()
                total += 512 * status.st_blocks if stat.S_ISREG(status.st_mode) else 0
    return total


@dataclass(frozen=True)
class Machine:
    """What there is."""

    free_disk_bytes: int
    disk_bytes: int
    memory_bytes: int | None
    """None where workers run elsewhere."""

    @classmethod
    def of(cls, folder: Path, *, has_workers: bool = True) -> Machine:
        """This machine, and the disk of a folder."""
        disk = shutil.disk_usage(folder)
        return cls(disk.free, disk.total, psutil.virtual_memory().total if has_workers else None)


class Admission:
    """Holds jobs back; remembers why.

    Args:
        look: what the machine has now.
    """

    def __init__(self, look: Callable[[], Machine], clock: Callable[[], float] = time.monotonic) -> None:
        self._look, self._clock = look, clock
        self._lock = threading.Lock()
        self._needs: dict[str, Needs] = {}
        self._paused: dict[str, tuple[float, str]] = {}
        self._reasons: dict[str, str] = {}

    def refuse_too_large(self, spec: JobSpec) -> None:
        """Refuse what this machine could never run.

        Raises:
            JobTooLargeError: it needs more disk or memory than there is in all.
        """
        needs, machine = predict(spec), self._look()
        if needs.disk_bytes > machine.disk_bytes - KEPT_FREE_BYTES:
            raise JobTooLargeError(
                f"The job needs about {_gib(needs.disk_bytes)} of disk and there are {_gib(machine.disk_bytes)} in all; put the server's data on a larger one.",
                {"needed_disk_bytes": needs.disk_bytes, "disk_bytes": machine.disk_bytes},
            )
        if machine.memory_bytes is not None and needs.memory_bytes > machine.memory_bytes:
            raise JobTooLargeError(
                f"{spec.workers} workers need about {_gib(needs.memory_bytes)} of memory and there are {_gib(machine.memory_bytes)}; ask for fewer workers.",
                {"needed_memory_bytes": needs.memory_bytes, "memory_bytes": machine.memory_bytes},
            )

    def holds(self, job_id: str, spec: JobSpec) -> bool:
        """Whether a queued job must wait; ``reason`` then says why, and does not wait for this, as the disk of a capture may hang."""
        machine = self._look()
        needs = self._needs.pop(job_id, None) or predict(spec)
        with self._lock:
            until, reason = self._paused.get(job_id, (0.0, ""))
            if self._clock() >= until:
                needed, reason = needs.disk_bytes + KEPT_FREE_BYTES, ""
                if machine.free_disk_bytes < needed:
                    reason = f"Waits for disk: about {_gib(needed)} are needed and {_gib(machine.free_disk_bytes)} are free."
                self._paused.pop(job_id, None)
            self._reasons.pop(job_id, None)
            if reason:
                self._needs[job_id], self._reasons[job_id] = needs, reason
            return bool(reason)

    def remember_only(self, job_ids: Iterable[str]) -> None:
        """Forget jobs that wait no more: cancelled, deleted or another server's."""
        waiting = set(job_ids)
        with self._lock:
            for known in (self._needs, self._paused, self._reasons):
                for job_id in known.keys() - waiting:
                    del known[job_id]

    def pause(self, job_id: str, problem: DentineError) -> None:
        """Let a job wait that could not go on."""
        what = "disk" if isinstance(problem, DiskFullError) else "store" if isinstance(problem, StoreError) else "workers"
        with self._lock:
            self._paused[job_id] = self._clock() + RETRY_S, f"Waits for {what}: {problem.message}"

    def reason(self, job_id: str) -> str | None:
        """Why a queued job does not start, None if nothing keeps it."""
        with self._lock:
            return self._reasons.get(job_id)


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"
