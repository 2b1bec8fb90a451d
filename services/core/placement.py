"""Which worker may do what, and how those that do the same are shared: Dask resources and priorities by name.

A resource here is a mark of what a worker can do, not an amount that is used up: a task that has given its thread back,
such as the driver of a fit, keeps what it holds. Only the dome is one, so that its worker runs one capture at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from services.core.records import Priority

DOME = "DOME"
"""The worker reaches the dome."""
STAGES = "STAGES"
"""The worker has shown that it can run every stage but the capture."""
UNLIMITED = 1_000_000
"""How much of a mark a worker has: more than there are tasks on it at once."""

WEIGHTS: Mapping[Priority, float] = MappingProxyType({"low": 0.25, "normal": 1.0, "high": 4.0})
"""Shares of the workers' time that running fits take, relative to each other."""


def rank(priority: Priority) -> int:
    """Which of two waiting jobs starts first: the one of the lower rank."""
    return -list(WEIGHTS).index(priority)
