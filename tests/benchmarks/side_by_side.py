"""Shares of the workers' time that concurrent jobs get, and the time that a capture waits beside them.

    python -m tests.benchmarks.side_by_side --json side.json [--repeats 5] [--seconds 40]

The server, a scheduler, two workers and a worker at the rig run as processes of their own. Two fits run on the workers;
their blocks occupy a worker for a known time and use no processor, so that a busy machine does not change the shares.
While both run, captures are submitted one after the other. A row states the first fit's share of the worker time while
both had blocks to run, and the time from a capture's submission until it began, alone and beside the fits. It takes
repeats x 4 cases x about a minute.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import httpx

from tests.support.block_stages import BLOCKS, read_trace
from tests.support.small_system import small_system

CAPTURES = 4
"""Number of captures per repeat beside the fits, and number of captures before them with no other jobs."""
TWO_WORKERS = 2


@dataclass(frozen=True)
class Case:
    """Two fits: seconds per block, priorities, and the delay of the second fit's start in seconds."""

    name: str
    block_s: tuple[float, float]
    priorities: tuple[str, str] = ("normal", "normal")
    later_s: float = 0.0


CASES = (
    Case("equal", (0.3, 0.3)),
    Case("blocks three times as long", (0.3, 0.9)),
    Case("the second starts later", (0.3, 0.3), later_s=15.0),
    Case("high beside normal", (0.3, 0.3), ("high", "normal")),
)


@dataclass(frozen=True)
class Row:
    """One repeat of a case."""

    case: str
    share: float
    """Share of the first fit in the worker time of both."""
    busy: float
    """Share of the two workers' time that the fits used."""
    window_s: float
    capture_alone_s: tuple[float, ...]
    capture_beside_s: tuple[float, ...]
    rig_ran_blocks: bool


def main() -> None:
    """Run every case and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=40.0, help="how long both fits run side by side")
    options = parser.parse_args()
    rows: list[Row] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        small_system(Path(folder), has_rig_apart=True, stages="tests.support.block_stages") as system,
        system.client() as client,
    ):
        for repeat in range(options.repeats):
            for number, case in enumerate(CASES):
                rows.append(run_case(client, Path(folder) / f"sources-{repeat}-{number}", case, options.seconds))
                print(json.dumps(asdict(rows[-1])), flush=True)
                options.json.write_text(json.dumps(summary(rows), indent=1) + "\n")


def run_case(client: httpx.Client, folder: Path, case: Case, seconds: float) -> Row:
    """Run the captures alone, then two fits with captures beside them."""
    alone_s = [capture_wait_s(client, folder / f"alone-{k}") for k in range(CAPTURES)]
    sources = [folder / "first", folder / "second"]
    jobs = []
    for source, block_s, priority in zip(sources, case.block_s, case.priorities, strict=True):
        source.mkdir(parents=True)
        (source / BLOCKS).write_text(json.dumps({"block_s": block_s, "blocks": 12, "steps": 10_000, "pause_s": 0.2}))
        jobs.append(submit(client, {"capture": str(source), "priority": priority}))
        while not read_trace(source):
            time.sleep(0.05)
        time.sleep(case.later_s if source is sources[0] else 0.0)
    since_s, beside_s = time.time(), []
    for k in range(CAPTURES):
        time.sleep(seconds / (CAPTURES + 1))
        beside_s.append(capture_wait_s(client, folder / f"beside-{k}"))
    time.sleep(max(since_s + seconds - time.time(), 0.0))
    until_s = time.time()
    for source in sources:
        (source / "enough").touch()
    for job in jobs:
        end(client, job)
    return row_of(case, sources, (since_s, until_s), alone_s, beside_s, client)


def row_of(
    case: Case,
    sources: Sequence[Path],
    window: tuple[float, float],
    alone_s: list[float],
    beside_s: list[float],
    client: httpx.Client,
) -> Row:
    """Compute a row from the parts of all blocks that lie within the window (start, end), in Unix time."""
    traces = [read_trace(source) for source in sources]
    used_s = [sum(max(min(end, window[1]) - max(start, window[0]), 0.0) for start, end, _ in trace) for trace in traces]
    ran = {worker for trace in traces for _, _, worker in trace}
    lasted_s = window[1] - window[0]
    return Row(
        case=case.name,
        share=used_s[0] / sum(used_s),
        busy=sum(used_s) / (TWO_WORKERS * lasted_s),
        window_s=lasted_s,
        capture_alone_s=tuple(alone_s),
        capture_beside_s=tuple(beside_s),
        rig_ran_blocks=len(ran) > TWO_WORKERS,
    )


def capture_wait_s(client: httpx.Client, source: Path) -> float:
    """Seconds from a capture's submission until it began, by the server's clock. Waits for the capture's end and
    cancels its job.
    """
    (source / "steering").mkdir(parents=True)
    job = submit(client, {"rig": {"mouth": str(source)}})
    while not (source / "steering" / "at-capture-end").exists():
        time.sleep(0.02)
    client.post(f"/v1/jobs/{job}/cancel")
    end(client, job)
    events = [
        json.loads(line.removeprefix("data: "))
        for line in client.get(f"/v1/jobs/{job}/events").text.splitlines()
        if '"kind"' in line
    ]
    submitted = next(event["time_s"] for event in events if event["kind"] == "state")
    return float(
        next(event["time_s"] for event in events if event["stage"] == "capture" and event["kind"] == "started")
        - submitted
    )


def submit(client: httpx.Client, spec: dict[str, Any]) -> str:
    """Submit a job; returns its id."""
    answer = client.post("/v1/jobs", json=spec | {"workers": TWO_WORKERS})
    answer.raise_for_status()
    return str(answer.json()["id"])


def end(client: httpx.Client, job: str) -> None:
    """Wait for a job's end."""
    client.get(f"/v1/jobs/{job}/events", timeout=600)


def summary(rows: list[Row]) -> dict[str, Any]:
    """Summary by case, and all rows."""
    by_case = {case.name: [row for row in rows if row.case == case.name] for case in CASES}
    return {
        "cases": {name: told(mine) for name, mine in by_case.items() if mine},
        "rows": [asdict(row) for row in rows],
    }


def told(rows: list[Row]) -> dict[str, Any]:
    """Summary of one case over its repeats."""
    alone = [wait_s for row in rows for wait_s in row.capture_alone_s]
    beside = [wait_s for row in rows for wait_s in row.capture_beside_s]
    return {
        "repeats": len(rows),
        "share_of_the_first": spread([row.share for row in rows]),
        "busy": spread([row.busy for row in rows]),
        "captures": len(beside),
        "capture_wait_alone_s": spread(alone),
        "capture_wait_beside_s": spread(beside),
        "rig_ran_blocks": any(row.rig_ran_blocks for row in rows),
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median and range of values."""
    return {"least": min(values), "median": statistics.median(values), "most": max(values)}


if __name__ == "__main__":
    main()
