"""A day of a laboratory, as fast as the server takes it, and its memory meanwhile.

Assumed, per quarter of an hour: 600 requests of the mix (57,600 a day: three dashboards and a watching script, one
request every 1.5 s), a scrape of the metrics every 15 s, one small capture uploaded, one job run and followed to its
end, the job of two hours ago deleted, eight event streams opened and left.
"""

from __future__ import annotations

import asyncio
import json
import random
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from services.client.client import Client
from services.core.errors import PlatformError
from tests.load.library import Library, fill
from tests.load.open_loop import Answer, send_one, session
from tests.load.processes import Served, serving
from tests.load.request_mix import Ask, RequestMix
from tests.support.uploading import write_capture

Row = dict[str, Any]
QUARTERS_OF_A_DAY = 96
REQUESTS, SCRAPES, STREAMS = 600, 60, 8
AT_ONCE = 8
KEPT_JOBS = 8
WARM_UP = 0.25
"""Of the curve: caches fill, threads start, the allocator finds its size. It is shown, and not judged."""


def measure(work: Path, quarters: int, seed: int) -> Iterator[Row]:
    """The memory after every quarter of an hour, then what it grows by in a day."""
    library = fill(work / "data", work / "capture", jobs=200, fitted=10)
    with serving(work / "data") as served, asyncio.Runner() as runner:
        day = _Day(served, library, work, random.Random(seed))
        curve: list[Row] = []
        for number in range(quarters):
            runner.run(day.quarter(number))
            curve.append({"benchmark": "load-day", "peer": "dentine", "hours": (number + 1) / 4} | day.figures())
            yield curve[-1]
    yield growth(curve)


def growth(curve: Sequence[Row]) -> Row:
    """Least squares after the warm-up.

    Neighbouring points are alike, so the interval comes from resampling whole blocks of residuals.
    """
    judged = curve[int(WARM_UP * len(curve)) :]
    days, size = (
        np.array([row["hours"] / 24 for row in judged]),
        np.array([row["rss_bytes"] for row in judged], dtype=float),
    )
    slope, start = np.polyfit(days, size, 1)
    fitted = start + slope * days
    rng, block = np.random.default_rng(1), max(2, round(len(judged) ** 0.5))
    slopes = []
    for _ in range(2000):
        firsts = rng.integers(0, len(judged) - block + 1, -(-len(judged) // block))
        noise = np.concatenate([(size - fitted)[first : first + block] for first in firsts])[: len(judged)]
        slopes.append(np.polyfit(days, fitted + noise, 1)[0])
    low, high = np.quantile(slopes, (0.025, 0.975))
    return {
        "benchmark": "load-day-summary",
        "peer": "dentine",
        "hours": curve[-1]["hours"],
        "requests": curve[-1]["requests"],
        "wrong": curve[-1]["wrong"],
        "wrong_kinds": curve[-1]["wrong_kinds"],
        "seconds": curve[-1]["seconds"],
        "rss_start_bytes": curve[0]["rss_bytes"],
        "rss_warm_bytes": judged[0]["rss_bytes"],
        "rss_middle_bytes": curve[len(curve) // 2]["rss_bytes"],
        "rss_end_bytes": judged[-1]["rss_bytes"],
        "rss_bytes_by_hour": [row["rss_bytes"] for row in curve[3::4]],
        "growth_bytes_per_day": round(float(slope)),
        "growth_bytes_per_day_95": [round(float(low)), round(float(high))],
    }


class _Day:
    """Asks for a quarter of an hour's worth at a time."""

    def __init__(self, served: Served, library: Library, work: Path, rng: random.Random) -> None:
        self._served, self._library, self._work, self._rng = served, library, work, rng
        self._mix = RequestMix(library, rng, "day")
        self._jobs: deque[str] = deque()
        self._requests, self._wrong = 0, Counter[str]()
        self._began_s = time.perf_counter()

    def figures(self) -> Row:
        """Of the server by now."""
        rss, pss = self._served.memory_bytes()
        done = {
            "requests": self._requests,
            "wrong": self._wrong.total(),
            "wrong_kinds": dict(self._wrong),
            "seconds": round(time.perf_counter() - self._began_s, 1),
        }
        process = self._served.process
        held = {"files": process.num_fds(), "threads": process.num_threads()}
        return done | {"rss_bytes": rss, "pss_bytes": pss, "workers_pss_bytes": self._served.workers_bytes()} | held

    async def quarter(self, number: int) -> None:
        """All of it, at most so many requests at once."""
        asks = [self._mix.draw() for _ in range(REQUESTS)] + [Ask("metrics", "GET", "/v1/metrics")] * SCRAPES
        self._rng.shuffle(asks)
        waiting = iter(asks)
        async with session(self._served) as http:
            streams = [asyncio.create_task(self._look_in(http)) for _ in range(STREAMS)]
            work = [self._ask(http, waiting) for _ in range(AT_ONCE)]
            await asyncio.gather(*work, self._run_job(http, number), asyncio.to_thread(self._upload, number))
            for stream in streams:
                stream.cancel()
            await asyncio.gather(*streams, return_exceptions=True)

    async def _ask(self, http: aiohttp.ClientSession, asks: Iterator[Ask]) -> None:
        for ask in asks:
            self._count(await send_one(http, ask, 0.0))

    async def _run_job(self, http: aiohttp.ClientSession, number: int) -> None:
        answer = await send_one(http, self._mix.submit(seed=number), 0.0)
        self._count(answer)
        job = json.loads(answer.body)["id"]
        self._count(await send_one(http, Ask("follow", "GET", f"/v1/jobs/{job}/events"), 0.0))
        self._jobs.append(job)
        if len(self._jobs) > KEPT_JOBS:
            self._count(await send_one(http, Ask("delete", "DELETE", f"/v1/jobs/{self._jobs.popleft()}"), 0.0))

    async def _look_in(self, http: aiohttp.ClientSession) -> None:
        """Open the stream of whatever job is the newest, and leave in the middle."""
        async with http.get("/v1/jobs?limit=1") as answer:
            job = (await answer.json())["jobs"][0]["id"]
        async with http.get(f"/v1/jobs/{job}/events") as response:
            async for _ in response.content:
                await asyncio.sleep(0.01)

    def _upload(self, number: int) -> None:
        folder = write_capture(self._work / f"day-{number}", seed=number + 1)
        try:
            with Client(self._served.address) as client:
                client.upload(folder)
        except PlatformError:  # whoever uploads would ask again
            self._wrong["upload: no answer"] += 1

    def _count(self, answer: Answer) -> None:
        self._requests += 1
        if not answer.is_right:
            self._wrong[f"{answer.kind}: {answer.status}"] += 1
