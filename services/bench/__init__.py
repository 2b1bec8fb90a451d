"""Run time against error, with peers in the same run. Every benchmark returns rows; see ``Row``."""

from __future__ import annotations

from services.core.geometry import Record


class Row(Record):
    """One measured point."""

    benchmark: str
    peer: str
    """Who was measured; ``dentine`` is this engine."""
    seconds: float
    error: float
    """Relative standard error of the whole result, sqrt(sum of variances) / norm."""
    efficiency_ratio: float | None = None
    """Our 1 / (variance x time) divided by the peer's; only in a peer's summary row."""
