"""Check that a slab's job that is killed at random and run again gives the same result to the last digit.

python -m tests.benchmarks.slab_kill --times 20 --json slab_kill.json      about a minute per kill on two idle cores

A small cell of two wavelengths (or, every second time, of one, whose blocks of paths both workers share) is fitted once
undisturbed. Then each new run is killed by SIGKILL after a random share of that duration, either all its processes at
once or one worker alone. If it does not finish by itself, it is run again until it does. Its result files are compared
byte by byte with those of the undisturbed run. A run that ended before the kill does not count. The file keeps the
results of an earlier run, and a new run continues after them.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from services.tasks.journal import read_entries
from tests.support.small_slab import TRUTHS, write_cell

RESULTS = ("parameters.json", "phase.json", "errors.json")
VICTIMS = ("all", "worker")
MAX_RUNS = 5
"""Largest number of runs after a kill; the job must finish within them."""
PATIENCE_S = 1800.0


def begin(job: Path, out: Path) -> subprocess.Popen[bytes]:
    """Start ``dentine run``, with all its workers in a process group of its own."""
    command = [sys.executable, "-m", "services", "run", str(job), "--out", str(out)]
    with out.with_suffix(".log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def strike(process: subprocess.Popen[bytes], victim: str, draw: random.Random) -> bool:
    """Kill all processes of a run, or one of its workers, by SIGKILL; returns whether there was a process to kill."""
    if victim == "all":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        return process.wait() == -signal.SIGKILL
    workers = [one for one in psutil.Process(process.pid).children(recursive=True) if _is_worker(one)]
    if not workers:
        return False
    with suppress(psutil.NoSuchProcess):
        draw.choice(workers).kill()
        return process.poll() is None
    return False


def _is_worker(process: psutil.Process) -> bool:
    with suppress(psutil.NoSuchProcess):
        return "spawn_main" in " ".join(process.cmdline())
    return False


def results(out: Path) -> dict[str, bytes]:
    """Contents of the result files by name."""
    return {name: (out / name).read_bytes() for name in RESULTS}


def one_time(job: Path, out: Path, after_s: float, victim: str, draw: random.Random, expected: dict[str, bytes]) -> Any:
    """Run a job, kill it after ``after_s``, run it again; returns a row, or None if the run ended before the kill."""
    began = time.monotonic()
    process = begin(job, out)
    with suppress(subprocess.TimeoutExpired):
        process.wait(timeout=after_s)
        return None
    done = sum("fit" in read_entries(one) for one in out.glob("fit-checkpoint/*/journal.jsonl"))
    struck = strike(process, victim, draw)
    code = process.wait(timeout=PATIENCE_S)
    if not struck:
        return None
    runs = 0
    while code != 0 and runs < MAX_RUNS:
        code, runs = begin(job, out).wait(timeout=PATIENCE_S), runs + 1
    return {
        "job": job.stem,
        "killed": victim,
        "after_s": round(after_s, 2),
        "wavelengths_done_before": done,
        "runs_after": runs,
        "seconds": round(time.monotonic() - began, 1),
        "same": code == 0 and results(out) == expected,
    }


def write_job(folder: Path, wavelengths_nm: Sequence[float], effort: float) -> Path:
    """Write a cell and the job that fits it; returns the job's file."""
    (cell := folder / f"cell-{len(wavelengths_nm)}").mkdir()
    write_cell(cell, *wavelengths_nm)
    job = folder / f"wavelengths-{len(wavelengths_nm)}.toml"
    job.write_text(f'kind = "slab"\ncapture = "{cell.name}"\neffort = {effort}\nworkers = 2\n')
    return job


def main() -> None:
    """Kill ``--times`` runs, and write the result of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument(
        "--effort", type=float, default=0.1, help="of the job; more makes the fit a larger part of its time"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(arguments.json.read_text())["times"] if arguments.json.exists() else []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        jobs = [write_job(folder, nm, arguments.effort) for nm in (tuple(TRUTHS), tuple(TRUTHS)[:1])]
        expected, seconds = {}, {}
        for job in jobs:
            began, out = time.monotonic(), folder / f"undisturbed-{job.stem}"
            if begin(job, out).wait(timeout=PATIENCE_S) != 0:
                raise SystemExit(out.with_suffix(".log").read_text())
            expected[job], seconds[job] = results(out), time.monotonic() - began
        attempt = 0
        while len(rows) < arguments.times:
            draw = random.Random(f"{arguments.seed}/{len(rows)}/{attempt}")
            job, victim = jobs[len(rows) % 2], VICTIMS[len(rows) // 2 % 2]
            out, after_s = folder / f"time-{len(rows)}-{attempt}", draw.random() * seconds[job]
            attempt += 1
            if (row := one_time(job, out, after_s, victim, draw, expected[job])) is None:
                continue
            rows.append(row)
            print(json.dumps(row), flush=True)
            told = {"undisturbed_s": {job.stem: round(one, 1) for job, one in seconds.items()}, "times": rows}
            arguments.json.write_text(json.dumps(told, indent=1))
    bad = sum(not row["same"] for row in rows)
    print(f"{len(rows)} kills, {bad} of them with another answer")
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
