"""Class of a machine: machines of one class take equally long for the same work."""

from __future__ import annotations

import os
from pathlib import Path

import psutil


def machine_class(proc: Path = Path("/proc")) -> str:
    """This machine's processor, cores, memory and graphics processors in one line."""
    cores, memory_gib = len(os.sched_getaffinity(0)), round(psutil.virtual_memory().total / 2**30)
    parts = [_field(proc / "cpuinfo", "model name") or "unknown processor", f"{cores} cores", f"{memory_gib} GiB"]
    devices = [_field(path, "Model") for path in sorted((proc / "driver" / "nvidia" / "gpus").glob("*/information"))]
    return ", ".join([*parts, *(device for device in devices if device)])


def _field(path: Path, name: str) -> str:
    if not path.is_file():
        return ""
    found = (
        line.partition(":")[2].strip()
        for line in path.read_text().splitlines()
        if line.partition(":")[0].strip() == name
    )
    return next(found, "")
