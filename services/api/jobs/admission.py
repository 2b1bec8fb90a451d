"""Decides which queued jobs may start, and what the others wait for: a slot beside the running jobs, disk, memory, a
dome or workers.

A job that needs more disk or memory than the machine has in total is refused when it is submitted.
"""

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

from services.api.jobs.records import Job
from services.client.errors import JobTooLargeError
from services.core.errors import DentineError, DiskFullError, StoreError
from services.core.placement import rank
from services.core.records import JobSpec
from services.core.store import MANIFEST

DISK_PER_CAPTURE = 6.0
"""Bytes that a job stores per byte of its capture. The job of the demonstration stores 4.8 MB of 0.85 MB, most of them
compressed images."""
MIN_DISK_BYTES = 64 * 2**20
"""Bytes that a job stores however small its capture is: pictures, checkpoint and asset."""
RIG_CAPTURE_BYTES = 2 * 2**30
"""Assumed size in bytes of a capture that a rig is about to take."""
DEMO_CAPTURE_BYTES = 2**23
"""Assumed size in bytes of the capture that the demonstration's rig takes; its mouth's images take 2.1 MB."""
WORKER_BYTES = 3 * 2**29
"""Memory in bytes of one worker and its rendering process in the fit of a jaw; 1.1 GiB were measured."""
MAX_FILES = 5_000
"""Largest number of files of a capture whose sizes are added up."""
_DESCRIPTIONS = ("capture.json", "raw.toml", "slab.json", MANIFEST, f"capture/{MANIFEST}")
"""Files of which one marks a folder as a capture, or as a job that holds one."""
KEPT_FREE_BYTES = 256 * 2**20
"""Bytes of disk that are kept free and that no job may count on."""
DEFAULT_MAX_RUNNING = 4
"""Largest number of jobs that run side by side, unless the settings say otherwise. A further job ends none of them
sooner, as they share the same workers, and takes memory; but two long jaws should not keep a short tooth waiting, and
while one job is prepared or solves, another one keeps the workers busy."""
RETRY_S = 10.0
"""Time in s that a job waits after it was paused."""


def queue_order(job: Job) -> tuple[int, int]:
    """Sort key for the order in which queued jobs start: those of higher priority first, among equals the oldest."""
    return rank(job.spec.priority), job.number


@dataclass(frozen=True)
class Needs:
    """Disk and memory that a job is predicted to need."""

    disk_bytes: int
    memory_bytes: int


def predict(spec: JobSpec) -> Needs:
    """Predict the needs of a job from the size of its capture and its number of workers."""
    rigs = DEMO_CAPTURE_BYTES if spec.is_demo else RIG_CAPTURE_BYTES
    size = rigs if spec.capture is None else _stored_bytes(spec.capture)
    return Needs(MIN_DISK_BYTES + round(DISK_PER_CAPTURE * size), WORKER_BYTES * spec.workers)


def _stored_bytes(folder: Path) -> int:
    # Add up the disk blocks of at most as many files as a capture may have. A folder that is no capture, such as '/',
    # is not walked through here; its stage refuses it. A folder that cannot be listed, as on a mount that went away,
    # does not keep other jobs from starting.
    total = 0
    with suppress(OSError):
        if not any((folder / one).is_file() for one in _DESCRIPTIONS):
            return 0
        for path in itertools.islice(folder.rglob("*"), MAX_FILES):
            with suppress(OSError):
                status = path.lstat()
                total += 512 * status.st_blocks if stat.S_ISREG(status.st_mode) else 0
    return total


@dataclass(frozen=True)
class Machine:
    """Disk and memory of the machine."""

    free_disk_bytes: int
    disk_bytes: int
    memory_bytes: int | None
    """Total memory in bytes; None where the workers run on other machines."""

    @classmethod
    def of(cls, folder: Path, *, has_workers: bool = True) -> Machine:
        """Measure this machine, with the disk of a folder."""
        disk = shutil.disk_usage(folder)
        return cls(disk.free, disk.total, psutil.virtual_memory().total if has_workers else None)


_QUEUE_REASONS = ("Waits for a place", "Waits for the dome")
"""Beginnings of the reasons which say that a job waits for its turn in the queue."""


@dataclass
class _Running:
    """A job that was started and has not ended."""

    number: int
    needs: Needs
    dome: str | None
    """Address of the dome that the job captures with; None where it does not capture."""
    has_slot: bool
    """Whether the job counts among those that share the workers; False while it only captures."""
    begun_s: float
    sharing_then_s: float
    """Value of ``Admission._sharing_s`` when the job began."""


class Admission:
    """Holds jobs back and remembers why.

    Args:
        measure_machine: returns the disk and memory that the machine has now.
        clock: time in s that no step of the system clock changes.
        max_running: largest number of jobs that run side by side. A capture needs no slot: it has a worker of its own,
            and a person waits.
        missing_workers: returns why no worker can capture (for True) or run other stages (for False); None if one can.
    """

    def __init__(
        self,
        measure_machine: Callable[[], Machine],
        clock: Callable[[], float] = time.monotonic,
        max_running: int = DEFAULT_MAX_RUNNING,
        missing_workers: Callable[[bool], str | None] = lambda _: None,
    ) -> None:
        self._measure_machine, self._clock, self._max_running, self._missing_workers = (
            measure_machine,
            clock,
            max_running,
            missing_workers,
        )
        self._lock = threading.Lock()
        self._needs: dict[str, Needs] = {}
        self._paused: dict[str, tuple[float, str]] = {}
        self._reasons: dict[str, str] = {}
        self._running: dict[str, _Running] = {}
        self._stalled: dict[str, str] = {}
        self._shortages: dict[bool, str | None] = {}
        self._first_in_line = ""
        self._sharing_s, self._summed_to_s = 0.0, clock()

    @property
    def sharing(self) -> int:
        """Number of jobs that share the workers now."""
        with self._lock:
            return len(self._slot_holders())

    def mean_sharing(self, job_id: str) -> float:
        """Mean number of jobs that have shared the workers since a job began, itself included."""
        with self._lock:
            self._sum_sharing()
            job = self._running[job_id]
            lasted_s = self._summed_to_s - job.begun_s
            return max((self._sharing_s - job.sharing_then_s) / lasted_s, 1.0) if lasted_s > 0 else 1.0

    def refuse_too_large(self, spec: JobSpec) -> None:
        """Refuse a job that this machine could never run.

        Raises:
            JobTooLargeError: the job needs more disk or memory than the machine has in total.
        """
        needs, machine = predict(spec), self._measure_machine()
        if needs.disk_bytes > machine.disk_bytes - KEPT_FREE_BYTES:
            raise JobTooLargeError(
                f"The job needs about {_gib(needs.disk_bytes)} of disk and there are {_gib(machine.disk_bytes)} in all;"
                " put the server's data on a larger one.",
                {"needed_disk_bytes": needs.disk_bytes, "disk_bytes": machine.disk_bytes},
            )
        if machine.memory_bytes is not None and needs.memory_bytes > machine.memory_bytes:
            raise JobTooLargeError(
                f"{spec.workers} workers need about {_gib(needs.memory_bytes)} of memory and there are"
                f" {_gib(machine.memory_bytes)}; ask for fewer workers.",
                {"needed_memory_bytes": needs.memory_bytes, "memory_bytes": machine.memory_bytes},
            )

    def begin_round(self, job_ids: Iterable[str]) -> None:
        """Forget the findings of the last round, and the jobs that no longer wait because they were cancelled, deleted
        or taken by another server.

        Args:
            job_ids: the jobs that wait, in the order in which ``holds`` will be called for them.
        """
        waiting = set(job_ids)
        with self._lock:
            self._shortages, self._first_in_line = {}, ""
            for known in (self._needs, self._paused, self._reasons):
                for job_id in known.keys() - waiting:
                    del known[job_id]

    def holds(self, job_id: str, spec: JobSpec, *, is_to_capture: bool = False) -> bool:
        """Whether a queued job must wait. ``reason`` says why afterwards; it does not look again, because the disk of a
        capture may hang.
        """
        reason = self._obstacle(job_id, spec, is_to_capture=is_to_capture)
        with self._lock:
            self._reasons.pop(job_id, None)
            if reason:
                self._reasons[job_id] = reason
        return bool(reason)

    def start(self, job_id: str, number: int, spec: JobSpec, *, is_to_capture: bool = False) -> None:
        """Count a job among those that run."""
        needs = self._needs.pop(job_id, None) or predict(spec)
        dome = spec.rig.dome if is_to_capture and spec.rig else None
        with self._lock:
            self._sum_sharing()
            self._running[job_id] = _Running(number, needs, dome, not is_to_capture, self._summed_to_s, self._sharing_s)

    def try_claim_slot(self, job_id: str) -> bool:
        """Whether a job that has captured may go on with its other stages; if so, it takes a slot like any other
        job.
        """
        memory_bytes = self._measure_machine().memory_bytes
        with self._lock:
            job = self._running[job_id]
            job.dome = None
            if not job.has_slot:
                self._sum_sharing()
                job.has_slot = not self._slot_obstacle() and not self._memory_obstacle(job.needs, memory_bytes)
            return job.has_slot

    def end(self, job_id: str) -> None:
        """Remove a job from those that run."""
        with self._lock:
            self._sum_sharing()
            del self._running[job_id]
            self._stalled.pop(job_id, None)

    def find_stalled(self) -> None:
        """Find the running jobs whose next task no worker can take. ``stalled`` then says why, until a later look finds
        a worker that can.
        """
        with self._lock:
            captures = {job_id: job.dome is not None for job_id, job in self._running.items()}
        shortage = {kind: self._missing_workers(kind) for kind in set(captures.values())}
        with self._lock:
            current = {job_id: shortage[kind] for job_id, kind in captures.items() if job_id in self._running}
            self._stalled = {job_id: f"Waits for workers: {why}" for job_id, why in current.items() if why is not None}

    def pause(self, job_id: str, problem: DentineError) -> None:
        """Make a job wait for ``RETRY_S`` because a problem has stopped it."""
        what = (
            "disk" if isinstance(problem, DiskFullError) else "store" if isinstance(problem, StoreError) else "workers"
        )
        with self._lock:
            self._paused[job_id] = self._clock() + RETRY_S, f"Waits for {what}: {problem.message}"

    def stalled(self, job_id: str) -> str | None:
        """Why a running job does not go on; None if it does."""
        with self._lock:
            return self._stalled.get(job_id)

    def reason(self, job_id: str, *, ignore_queue: bool = False) -> str | None:
        """Why a queued job does not start; None if nothing keeps it, or with ``ignore_queue`` nothing but the queue."""
        with self._lock:
            reason = self._reasons.get(job_id)
            return None if ignore_queue and reason is not None and reason.startswith(_QUEUE_REASONS) else reason

    def _obstacle(self, job_id: str, spec: JobSpec, *, is_to_capture: bool) -> str:
        # Look for the obstacle that costs least to find first. Nothing slow is done under the lock.
        with self._lock:
            if job_id in self._running:
                return "Waits until its earlier run has ended."
            if obstacle := self._pause_obstacle(job_id) or (
                self._dome_obstacle(spec) if is_to_capture else self._slot_obstacle()
            ):
                return obstacle
        if is_to_capture not in self._shortages:
            self._shortages[is_to_capture] = self._missing_workers(is_to_capture)
        if (shortage := self._shortages[is_to_capture]) is not None:
            return f"Waits for workers: {shortage}"
        machine = self._measure_machine()
        needs = self._needs[job_id] = self._needs.get(job_id) or predict(spec)
        with self._lock:
            return self._disk_obstacle(needs, machine) or (
                "" if is_to_capture else self._queue_obstacle(needs, machine)
            )

    def _queue_obstacle(self, needs: Needs, machine: Machine) -> str:
        if self._first_in_line:
            return self._first_in_line
        if short := self._memory_obstacle(needs, machine.memory_bytes):
            # A job that needs much memory would never start if all that need less went before it.
            self._first_in_line = "Waits behind a job that is before it and waits for memory."
        return short

    def _pause_obstacle(self, job_id: str) -> str:
        until, reason = self._paused.get(job_id, (0.0, ""))
        if self._clock() < until:
            return reason
        self._paused.pop(job_id, None)
        return ""

    def _dome_obstacle(self, spec: JobSpec) -> str:
        dome = spec.rig.dome if spec.rig else None
        busy = next((job.number for job in self._running.values() if job.dome == dome), None)
        return "" if busy is None else f"{_QUEUE_REASONS[1]} {dome}: job {busy} captures with it."

    def _slot_obstacle(self) -> str:
        holders = self._slot_holders()
        return (
            f"{_QUEUE_REASONS[0]}: {_named(holders)}, and {self._max_running} at once is the most."
            if len(holders) >= self._max_running
            else ""
        )

    def _memory_obstacle(self, needs: Needs, memory_bytes: int | None) -> str:
        holders = self._slot_holders()
        held = sum(job.needs.memory_bytes for job in holders)
        if memory_bytes is None or not holders or held + needs.memory_bytes <= memory_bytes:
            return ""
        what = (
            f"about {_gib(needs.memory_bytes)} are needed beside the {_gib(held)} of those that run, and there are"
            f" {_gib(memory_bytes)}"
        )
        return f"Waits for memory: {_named(holders)}; {what}."

    def _disk_obstacle(self, needs: Needs, machine: Machine) -> str:
        # A running job counts with all the disk that it was predicted to need, because what it has written already is
        # not measured again.
        kept = sum(job.needs.disk_bytes for job in self._running.values())
        if machine.free_disk_bytes >= needs.disk_bytes + kept + KEPT_FREE_BYTES:
            return ""
        beside = f" beside {_gib(kept)} that running jobs may take" if kept else ""
        needed = needs.disk_bytes + KEPT_FREE_BYTES
        return f"Waits for disk: about {_gib(needed)} are needed{beside} and {_gib(machine.free_disk_bytes)} are free."

    def _sum_sharing(self) -> None:
        now_s = self._clock()
        self._sharing_s += len(self._slot_holders()) * (now_s - self._summed_to_s)
        self._summed_to_s = now_s

    def _slot_holders(self) -> list[_Running]:
        return [job for job in self._running.values() if job.has_slot]


def _named(jobs: list[_Running]) -> str:
    numbers = [str(job.number) for job in sorted(jobs, key=lambda job: job.number)]
    return f"job {numbers[0]} runs" if len(numbers) == 1 else f"jobs {', '.join(numbers[:-1])} and {numbers[-1]} run"


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"
