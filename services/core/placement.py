"""Dask resources and priorities by name: which worker may run a stage, and how jobs share the workers.

A resource here marks what a worker can do and is not an amount that is used up, because a task that has given its
thread back, such as the driver of a fit, keeps the resources that it holds. Only the dome has an amount of 1, so that
its worker runs one capture at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from services.core.records import Priority

DOME = "DOME"
"""Resource of a worker that reaches the dome."""
STAGES = "STAGES"
"""Resource of a worker that has shown that it can run every stage but the capture."""
UNLIMITED = 1_000_000
"""Amount of ``STAGES`` that a worker has: more than the number of tasks that it ever has at once."""

WEIGHTS: Mapping[Priority, float] = MappingProxyType({"low": 0.25, "normal": 1.0, "high": 4.0})
"""Priority -> relative share of the workers' time that a running fit takes."""


def rank(priority: Priority) -> int:
    """The rank of a priority. Of two waiting jobs the one with the lower rank starts first."""
    return -list(WEIGHTS).index(priority)
