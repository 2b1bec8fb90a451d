"""Many jobs submitted at once, each of them twice: whether all are accounted for, each was run once, and they ran in
their order.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from tests.load.library import fill
from tests.load.open_loop import session
from tests.load.processes import Served, serving

Row = dict[str, Any]
STAGES = ("prepare", "fit", "export")


def measure(work: Path, jobs: int, seed: int) -> Iterator[Row]:
    """One row."""
    library = fill(work / "data", work / "capture", jobs=1, fitted=1)
    with serving(work / "data") as served:
        yield asyncio.run(_submit(served, str(library.capture), jobs, seed))


async def _submit(served: Served, capture: str, count: int, seed: int) -> Row:
    async with session(served, connections=0) as http:
        began_s, latencies_s = time.perf_counter(), []

        async def submit(number: int) -> str:
            asked_s = time.perf_counter()
            body = {"capture": capture, "workers": 1, "seed": seed + number}
            async with http.post("/v1/jobs", json=body, headers={"Idempotency-Key": f"queued-{number}"}) as answer:
                assert answer.status in {200, 201}, await answer.text()
                job = (await answer.json())["id"]
            latencies_s.append(time.perf_counter() - asked_s)
            return str(job)

        ids = await asyncio.gather(*(submit(number) for number in range(count) for _ in range(2)))
        submitted_s = time.perf_counter() - began_s
        jobs = set(ids)
        while await _unfinished(http):
            await asyncio.sleep(0.2)
        found = [await _account(http, served, job) for job in jobs]
    started = [one["started"] for one in sorted(found, key=lambda one: one["number"])]
    return {
        "benchmark": "load-queue",
        "peer": "dentine",
        "submitted": count,
        "jobs": len(jobs),
        "succeeded": sum(one["state"] == "SUCCEEDED" for one in found),
        "run_once": sum(one["run_once"] for one in found),
        "in_order": started == sorted(started),
        "submit_p50_s": round(float(np.quantile(latencies_s, 0.5)), 4),
        "submit_p99_s": round(float(np.quantile(latencies_s, 0.99)), 4),
        "submitted_s": round(submitted_s, 2),
        "all_run_s": round(time.perf_counter() - began_s, 2),
    }


async def _unfinished(http: aiohttp.ClientSession) -> Sequence[Any]:
    async with http.get("/v1/jobs?state=QUEUED&state=RUNNING&limit=1") as answer:
        jobs: Sequence[Any] = (await answer.json())["jobs"]
        return jobs


async def _account(http: aiohttp.ClientSession, served: Served, job: str) -> Row:
    """What the job's own row, its events and its folder say."""
    async with http.get(f"/v1/jobs/{job}") as answer:
        row = await answer.json()
    async with http.get(f"/v1/jobs/{job}/events") as answer:
        lines = (await answer.text()).splitlines()
    events = [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: {")]
    running = [event["id"] for event in events if event["kind"] == "state" and event["data"]["state"] == "RUNNING"]
    begun = Counter(event["stage"] for event in events if event["kind"] == "started")
    published = (served.data / "jobs" / job / "publications.txt").read_text().split()
    run_once = len(running) == 1 and begun == Counter(STAGES) and published == list(STAGES)
    return {"number": row["number"], "state": row["state"], "started": running[0], "run_once": run_once}
