"""How Dask is told to behave wherever stages run on workers."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

DASK_CONFIG: Mapping[str, Any] = MappingProxyType(
    {
        # What Dask samples and remembers for its developers: the stack a hundred times a second, the loop's delay fifty
        # times, a thousand messages and transitions with their tasks at each end of each connection.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "500ms",
        "distributed.admin.low-level-log-length": 50,
        "distributed.admin.log-length": 500,
        "distributed.admin.system-monitor.interval": "10s",
        "distributed.admin.system-monitor.log-length": 120,
        # Its HTTP servers have nothing to say that this program does not say itself.
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        # Dask has workers give freed memory back at once, and to glibc any value given here also says to map and clear
        # every array above 128 kB anew, which took a fifth of a preparation's time on one worker and a third on two.
        # These are the values that glibc comes to by itself where it is told nothing: bytes from which an array is
        # mapped, and bytes that are kept when free.
        "distributed.nanny.pre-spawn-environ": {
            "MALLOC_MMAP_THRESHOLD_": 1 << 25,
            "MALLOC_TRIM_THRESHOLD_": 1 << 26,
            "OMP_NUM_THREADS": 1,
            "MKL_NUM_THREADS": 1,
            "OPENBLAS_NUM_THREADS": 1,
        },
        # A line for every health check would be nearly all that a scheduler logs; what a stranger tried is a warning
        # and stays.
        "distributed.logging": {"distributed": "info", "distributed.comm.tcp": "warning"},
    }
)


def as_environment() -> dict[str, str]:
    """The same as environment variables, for processes that are Dask's own commands."""
    return {
        f"DASK_{name.replace('.', '__').replace('-', '_').upper()}": str(value) for name, value in DASK_CONFIG.items()
    }
