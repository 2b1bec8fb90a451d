"""Benchmarks of run time against error, with peers measured in the same run. Every benchmark returns rows (``Row``)."""

from __future__ import annotations

from services.core.geometry import Record


class Row(Record):
    """One measured point."""

    benchmark: str
    peer: str
    """Name of the program or method that was measured; ``dentine`` is this engine."""
    seconds: float
    """Run time; the benchmark says whether it is processor time or time by the clock."""
    error: float
    """Relative standard error of the whole result, sqrt(sum of variances) / norm."""
    efficiency_ratio: float | None = None
    """This engine's 1 / (variance x time) divided by the peer's; only in a peer's summary row."""
