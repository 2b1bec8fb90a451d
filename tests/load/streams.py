"""Many event streams on one running job: whether each gets every event in order, how long after its commit, and what
that costs the server.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from tests.load.library import fill
from tests.load.open_loop import session
from tests.load.processes import Served, serving
from tests.load.stages import GO

Row = dict[str, Any]


@dataclass
class Stream:
    """What one stream was told."""

    ids: list[int] = field(default_factory=list)
    delays_s: dict[int, float] = field(default_factory=dict)
    """From the commit to the arrival, of events that came while it listened."""
    final: str | None = None


def measure(work: Path, streams: int, steps: int, period_s: float, seed: int) -> Iterator[Row]:
    """One row."""
    library = fill(work / "data", work / "capture", jobs=1, fitted=1)
    with serving(work / "data") as served:
        yield asyncio.run(_listen(served, str(library.capture), streams, steps, period_s, seed))


async def _listen(served: Served, capture: str, count: int, steps: int, period_s: float, seed: int) -> Row:
    body = {
        "capture": capture,
        "workers": 1,
        "seed": seed,
        "solver": "adam",
        "adam_steps": steps,
        "adam_rate": period_s,
    }
    async with session(served, connections=0) as http:
        async with http.post("/v1/jobs", json=body) as answer:
            job = (await answer.json())["id"]
        before_bytes, listening = served.memory_bytes()[1], asyncio.Semaphore(0)
        streams = [Stream() for _ in range(count)]
        async with asyncio.TaskGroup() as following:
            for stream in streams:
                following.create_task(_follow(http, job, stream, listening))
            for _ in streams:
                await listening.acquire()
            open_bytes, cpu_s, began_s = served.memory_bytes()[1], served.cpu_s(), time.perf_counter()
            (served.data / "jobs" / job / GO).touch()
        seconds, cpu_s = time.perf_counter() - began_s, served.cpu_s() - cpu_s
        replayed = Stream()
        await _follow(http, job, replayed, listening)
    delays_s = [delay_s for stream in streams for delay_s in stream.delays_s.values()]
    return {
        "benchmark": "load-streams",
        "peer": "dentine",
        "streams": count,
        "events": len(replayed.ids),
        "live_events_per_stream": len(delays_s) / count,
        "whole_streams": sum(is_whole(stream, replayed) for stream in streams),
        "delay_p50_s": round(float(np.quantile(delays_s, 0.5)), 4),
        "delay_p99_s": round(float(np.quantile(delays_s, 0.99)), 4),
        "delay_max_s": round(max(delays_s), 4),
        "seconds": round(seconds, 2),
        "cpu_share": round(cpu_s / seconds, 3),
        "pss_before_bytes": before_bytes,
        "pss_open_bytes": open_bytes,
        "pss_after_bytes": served.memory_bytes()[1],
    }


def is_whole(stream: Stream, replayed: Stream) -> bool:
    """Whether a stream was told all that the table holds, in its order, each once, and the end."""
    return stream.ids == replayed.ids == sorted(set(replayed.ids)) and stream.final == replayed.final == "SUCCEEDED"


async def _follow(http: aiohttp.ClientSession, job: str, stream: Stream, listening: asyncio.Semaphore) -> None:
    """Read a stream to its end; ``listening`` is released once it stands."""
    opened_s = time.time()
    async with http.get(f"/v1/jobs/{job}/events") as response:
        listening.release()
        told: dict[str, str] = {}
        async for line in response.content:
            name, _, value = line.decode().rstrip("\n").partition(": ")
            if name:
                told[name] = value
            elif told:
                _take(stream, told, opened_s)
                told = {}


def _take(stream: Stream, told: Mapping[str, str], opened_s: float) -> None:
    if told.get("event") == "end":
        stream.final = json.loads(told["data"])
    elif "data" in told:
        event = json.loads(told["data"])
        stream.ids.append(event["id"])
        if event["time_s"] > opened_s:
            stream.delays_s[event["id"]] = time.time() - event["time_s"]
