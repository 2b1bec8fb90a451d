"""The configuration of Dask wherever stages run on workers."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

DASK_CONFIG: Mapping[str, Any] = MappingProxyType(
    {
        # Switch off or reduce what Dask records for its developers: the stack a hundred times a second, the event
        # loop's delay fifty times a second, and a thousand messages and transitions with their tasks at each end of
        # each connection.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "500ms",
        "distributed.admin.low-level-log-length": 50,
        "distributed.admin.log-length": 500,
        "distributed.admin.system-monitor.interval": "10s",
        "distributed.admin.system-monitor.log-length": 120,
        # Dask's HTTP servers offer nothing that this program does not offer itself.
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        # By default Dask makes workers return freed memory to the system at once. Any value given here also makes glibc
        # map and clear every array above 128 kB anew, which took a fifth of a preparation's time on one worker and a
        # third on two. These are the values that glibc reaches by itself without a setting: the size in bytes from
        # which an array is mapped, and the number of free bytes that are kept.
        "distributed.nanny.pre-spawn-environ": {
            "MALLOC_MMAP_THRESHOLD_": 1 << 25,
            "MALLOC_TRIM_THRESHOLD_": 1 << 26,
            "OMP_NUM_THREADS": 1,
            "MKL_NUM_THREADS": 1,
            "OPENBLAS_NUM_THREADS": 1,
        },
        # A line for every health check would be nearly all that a scheduler logs; an attempt of a stranger to connect
        # is a warning and is still logged.
        "distributed.logging": {"distributed": "info", "distributed.comm.tcp": "warning"},
    }
)


def as_environment() -> dict[str, str]:
    """The configuration as environment variables, for processes that run Dask's own commands."""
    return {
        f"DASK_{name.replace('.', '__').replace('-', '_').upper()}": str(value) for name, value in DASK_CONFIG.items()
    }
