"""What dashboards, watchers, scripts and a monitor ask of a server, drawn at random."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.load.library import PICTURE_BYTES, Library

RANGE_BYTES = 2**16
METRICS_PERIOD_S = 15.0
READY_PERIOD_S = 10.0
SUBMIT_PERIOD_S = 4.0
"""A new job this often, every second of which is cancelled a second later."""


@dataclass(frozen=True)
class Ask:
    """One request; ``statuses`` are the right answers."""

    kind: str
    method: str
    path: str
    headers: dict[str, str] = field(default_factory=dict)
    body: dict[str, Any] | None = None
    statuses: tuple[int, ...] = (200,)


class RequestMix:
    """Draws requests over a library; what is new in it is named by ``prefix``, so that no two mixes submit the same
    job.
    """

    def __init__(self, library: Library, rng: random.Random, prefix: str) -> None:
        self._library, self._rng, self._prefix, self._submitted = library, rng, prefix, 0
        self._weights: dict[Callable[[], Ask], float] = {
            self._list: 20,
            self._get: 22,
            self._history: 8,
            self._logs: 6,
            self._events: 8,
            self._previews: 4,
            self._artifacts: 4,
            self._range: 12,
            self._presets: 3,
            self._options: 2,
            self._live: 6,
            self._submit_again: 3,
            self._cancel_ended: 2,
        }

    def draw(self) -> Ask:
        """One request that leaves no job behind."""
        return self._rng.choices(list(self._weights), list(self._weights.values()))[0]()

    def submit(self, **options: Any) -> Ask:
        """A job that is new."""
        self._submitted += 1
        body = {"capture": str(self._library.capture), "workers": 1} | options
        return Ask("submit", "POST", "/v1/jobs", {"Idempotency-Key": f"{self._prefix}-{self._submitted}"}, body, (201,))

    def _any(self) -> str:
        return f"/v1/jobs/{self._rng.choice(self._library.jobs)}"

    def _fitted(self) -> str:
        return f"/v1/jobs/{self._rng.choice(self._library.fitted)}"

    def _list(self) -> Ask:
        queries = ("", "?state=RUNNING&state=QUEUED", "?kind=tooth&limit=20", "?limit=100")
        return Ask("list", "GET", f"/v1/jobs{self._rng.choice(queries)}")

    def _get(self) -> Ask:
        return Ask("get", "GET", self._any())

    def _history(self) -> Ask:
        return Ask("history", "GET", f"{self._fitted()}/history")

    def _logs(self) -> Ask:
        return Ask("logs", "GET", f"{self._fitted()}/logs")

    def _events(self) -> Ask:
        # A browser that comes back: the last twenty events of a job that has ended.
        return Ask(
            "events",
            "GET",
            f"/v1/jobs/{self._library.fitted[-1]}/events",
            {"Last-Event-ID": str(self._library.last_event - 20)},
        )

    def _previews(self) -> Ask:
        return Ask("previews", "GET", f"{self._fitted()}/previews")

    def _artifacts(self) -> Ask:
        return Ask("artifacts", "GET", f"{self._fitted()}/artifacts")

    def _range(self) -> Ask:
        first = self._rng.randrange(PICTURE_BYTES - RANGE_BYTES)
        path = f"{self._fitted()}/artifacts/previews/green-025-c0-l1-render.png"
        return Ask("range", "GET", path, {"Range": f"bytes={first}-{first + RANGE_BYTES - 1}"}, statuses=(206,))

    def _presets(self) -> Ask:
        return Ask("presets", "GET", "/v1/presets")

    def _options(self) -> Ask:
        return Ask("options", "GET", "/v1/options")

    def _live(self) -> Ask:
        return Ask("live", "GET", "/v1/health/live")

    def _submit_again(self) -> Ask:
        # The first one makes the job, all others find it.
        body = {"capture": str(self._library.capture), "workers": 1}
        return Ask("submit again", "POST", "/v1/jobs", {"Idempotency-Key": "again"}, body, (200, 201))

    def _cancel_ended(self) -> Ask:
        return Ask("cancel", "POST", f"{self._any()}/cancel", statuses=(409,))


def periodic(seconds: float) -> Iterator[tuple[float, Ask]]:
    """What a monitor asks meanwhile."""
    for period_s, ask in (
        (METRICS_PERIOD_S, Ask("metrics", "GET", "/v1/metrics")),
        (READY_PERIOD_S, Ask("ready", "GET", "/v1/health/ready")),
    ):
        due_s = period_s / 2
        while due_s < seconds:
            yield due_s, ask
            due_s += period_s
