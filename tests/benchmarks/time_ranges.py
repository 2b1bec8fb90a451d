"""Share of stated time ranges that contain the true remaining time, for jobs of several sizes on a live server, as
JSON.

python -m tests.benchmarks.time_ranges --jobs 45 --stages real --json time_ranges.json

Jobs are submitted one, two or three at a time, so that some wait for others. The server is asked for a job's range
after its submission and after its fit has begun.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

from services.client.client import Client
from services.core.records import JobSpec
from services.pipeline.machine_class import machine_class
from tests.support.live_server import running_server, toy_server
from tests.support.uploading import write_capture

Moment = Literal["submitted", "fit"]
DENTINE = [sys.executable, "-m", "services"]
PHANTOMS = (("3.0", "1", "4"), ("2.5", "1", "4"), ("2.0", "1", "4"), ("2.0", "1", "6"))
"""Pixel size in mm, number of cameras and number of lights of each phantom, as text."""


def write_phantoms(folder: Path) -> list[Path]:
    """Write phantom captures of several sizes; returns their folders."""
    captures = []
    for pixel_mm, cameras, lights in PHANTOMS:
        captures.append(folder / f"mouth-{pixel_mm}-{cameras}-{lights}")
        size = ["--pixel-mm", pixel_mm, "--cameras", cameras, "--lights", lights, "--samples", "64"]
        subprocess.run([*DENTINE, "phantom", "--out", str(captures[-1]), *size], check=True, stdout=subprocess.DEVNULL)
    return captures


def draw_job(chance: random.Random, captures: list[Path], samples: tuple[int, ...]) -> JobSpec:
    """Draw a small job: the options are fixed, capture and samples per pixel are drawn."""
    options: dict[str, Any] = {
        "boundary": "matched",
        "dentin": "known",
        "max_steps": 1,
        "search_candidates": 100,
        "advise": False,
        "workers": 1,
    }
    drawn = chance.choice(samples)
    return JobSpec(
        capture=chance.choice(captures),
        samples_per_pixel=drawn,
        max_samples_per_pixel=drawn,
        seed=chance.randrange(2**31),
        **options,
    )


def run_job(client: Client, job: str, told: dict[str, Any]) -> dict[str, Any]:
    """Follow a job to its end; returns its ranges with the true remaining times.

    Args:
        told: range that the server stated after the submission.
    """
    asked: dict[Moment, dict[str, Any]] = {"submitted": told}
    ended_s = 0.0
    for event in client.events(job):
        if event.kind == "started" and event.stage == "fit":
            asked["fit"] = ask(client, job)
        ended_s = event.time_s
    detail = client.get(job)
    assert detail["state"] == "SUCCEEDED", detail["failure"]
    row: dict[str, Any] = {"job": detail["number"]}
    for moment, range_ in asked.items():
        if range_["low_s"] is not None:
            truth_s = ended_s - range_["asked_s"]
            row[moment] = {**range_, "truth_s": truth_s, "held": range_["low_s"] <= truth_s <= range_["high_s"]}
    return row


def ask(client: Client, job: str) -> dict[str, Any]:
    """A job's stated range, and the Unix time of the question."""
    asked_s, remaining = time.time(), client.get(job)["remaining"]
    return {"low_s": None, "high_s": None, **(remaining or {}), "asked_s": asked_s}


def measure(
    client: Client, captures: list[Path], samples: tuple[int, ...], jobs: int, seed: int
) -> list[dict[str, Any]]:
    """Submit jobs in small groups; returns one row per job."""
    chance, rows = random.Random(seed), list[dict[str, Any]]()
    while len(rows) < jobs:
        group = [
            client.submit(draw_job(chance, captures, samples))["id"]
            for _ in range(min(chance.choice((1, 1, 1, 2, 3)), jobs - len(rows)))
        ]
        told = [ask(client, job) for job in group]
        for place, (job, range_) in enumerate(zip(group, told, strict=True)):
            rows.append(run_job(client, job, range_) | {"jobs_before": place, "load": os.getloadavg()[0]})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Share of ranges that contain the truth, by the moment of the question and by whether other jobs came first."""
    loads = [row["load"] for row in rows]
    told: dict[str, Any] = {
        "machine": machine_class(),
        "jobs": len(rows),
        "load_least": min(loads),
        "load_most": max(loads),
    }
    groups = {
        "submitted": rows,
        "submitted_first": [row for row in rows if not row["jobs_before"]],
        "submitted_behind": [row for row in rows if row["jobs_before"]],
    }
    for name, group in (groups | {"fit": rows}).items():
        ranges = [row[moment] for row in group if (moment := name.partition("_")[0]) in row]
        ratios = sorted(one["high_s"] / max(one["low_s"], 0.1) for one in ranges)
        held = sum(one["held"] for one in ranges)
        told[name] = {
            "ranges": len(ranges),
            "held": held,
            "share": held / max(len(ranges), 1),
            "median_ratio_of_limits": ratios[len(ratios) // 2] if ratios else None,
        }
    return told


def main() -> None:
    """Read the options, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=45)
    parser.add_argument(
        "--stages",
        choices=("real", "drawn"),
        default="real",
        help="real fits of tiny teeth, or stages of drawn durations",
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "server.log").open("w") as log:
        work = Path(folder)
        if options.stages == "real":
            captures, samples = write_phantoms(work), (4, 6, 8, 12, 16)
            server = running_server([*DENTINE, "serve", "--port", "0", "--data", str(work / "data")], log)
        else:
            captures, samples = [write_capture(work / "mine")], (8, 16, 32, 64, 128)
            server = toy_server(work / "data", log, "tests.support.drawn_stages")
        with server as (http, _), Client(str(http.base_url)) as client:
            rows = measure(client, captures, samples, options.jobs, options.seed)
    result = {"stages": options.stages, **summary(rows), "rows": rows}
    print(json.dumps({name: value for name, value in result.items() if name != "rows"}, indent=1))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
