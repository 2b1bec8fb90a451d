"""Counts of requests, by method, route and status."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Histogram

_LATENCIES_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class RequestMetrics:
    """Counts answers and their latency."""

    def __init__(self, registry: CollectorRegistry) -> None:
        labels = ("method", "route")
        self._answers = Counter(
            "dentine_requests",
            "Answers by method, route template and class of status",
            (*labels, "status"),
            registry=registry,
        )
        self._latency = Histogram(
            "dentine_request_latency_seconds",
            "Time to the head of the answer",
            labels,
            buckets=_LATENCIES_S,
            registry=registry,
        )

    def count(self, method: str, route: str, status: int, latency_s: float) -> None:
        """Count one answer."""
        method = method if method in METHODS else "other"
        self._answers.labels(method, route, f"{status // 100}xx").inc()
        self._latency.labels(method, route).observe(latency_s)
