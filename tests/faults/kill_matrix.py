"""Kill -9 of every part of the service at every boundary and in the middle of every stage.

python -m tests.faults.kill_matrix --out matrix.json

A job of toy stages runs through the real API, database, scheduler and workers. It is held at one point, one part is killed, what an orchestrator restarts is
started again, and the job is let go on. A cell is good when the job succeeded, every stage was published once and by its newest attempt, nothing half-written
is visible, the dome is dark, and the events tell of it in order. Parts: the API, the scheduler, the process that runs the stage, the whole host of that
process, and the database.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import httpx

from tests.support.small_system import SmallSystem, small_system

STAGES = ("capture", "prepare", "fit", "export")
POINTS = ("start", "middle", "end")
PARTS = ("api", "scheduler", "stage", "host", "database")
FOLDERS = {"capture": "capture", "prepare": "prepared", "fit": "fit", "export": "asset"}


@dataclass(frozen=True)
class Cell:
    """What was killed where, and how the job ended."""

    part: str
    stage: str
    point: str
    state: str
    attempts: dict[str, int]
    """Starts of each stage."""
    seconds: float
    """From the kill to the job's end."""
    faults: tuple[str, ...]
    """What is wrong; empty when the cell is good."""


def run_cell(system: SmallSystem, part: str, stage: str, point: str) -> Cell:
    """Run one job through one kill."""
    mouth = system.data.parent / "mouth"
    mouth.mkdir(exist_ok=True)
    with system.client() as client:
        job = client.post("/v1/jobs", json={"workers": 1, "rig": {"mouth": str(mouth)}}).raise_for_status().json()["id"]
    folder = system.data / "jobs" / job
    hold, reached = folder / f"hold-{stage}-{point}", folder / f"at-{stage}-{point}"
    folder.mkdir(parents=True, exist_ok=True)
    hold.touch()
    system.wait_until(reached.exists, f"stage {stage} never reached its {point}")
    pid = _pid(reached)

    began = time.monotonic()
    if part == "stage":
        os.kill(pid, signal.SIGKILL)
    elif part == "host":
        system.kill("rig" if stage == "capture" else _host_of(system, pid))
    else:
        system.kill(part)
    system.start(*(("database",) if part == "database" else ()))
    hold.unlink()
    job_ended = _Ended(system, job)
    system.wait_until(job_ended, f"job {job} did not end after {part} was killed at the {point} of {stage}")
    return _judge(folder, job_ended.detail, job_ended.events(), Cell(part, stage, point, job_ended.detail["state"], {}, time.monotonic() - began, ()))


def _host_of(system: SmallSystem, pid: int) -> str:
    return next(name for name in ("worker", "rig") if pid in system.pids(name))


def _pid(reached: Path) -> int:
    while not (text := reached.read_text()):
        time.sleep(0.01)
    return int(text)


class _Ended:
    """Whether a job has ended."""

    def __init__(self, system: SmallSystem, job: str) -> None:
        self._system, self._job = system, job
        self.detail: dict[str, Any] = {}

    def __call__(self) -> bool:
        with suppress(httpx.TransportError), self._system.client() as client:
            answer = client.get(f"/v1/jobs/{self._job}")
            if answer.status_code == 200:
                self.detail = answer.json()
        return self.detail.get("state") in {"SUCCEEDED", "FAILED", "CANCELLED"}

    def events(self) -> list[dict[str, Any]]:
        """All of them, as the stream replays them."""
        with self._system.client() as client:
            lines = client.get(f"/v1/jobs/{self._job}/events").text.splitlines()
        told = (json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: {"))
        return [event for event in told if "id" in event]


def _judge(folder: Path, detail: dict[str, Any], events: Sequence[dict[str, Any]], cell: Cell) -> Cell:
    faults = []
    if cell.state != "SUCCEEDED":
        faults.append(f"the job ended {cell.state}: {detail['failure']}")
    published = Counter((folder / "publications.txt").read_text().split())
    faults += [f"stage {stage} was published {published[stage]} times" for stage in STAGES if published[stage] != 1]
    attempts = {stage["stage"]: stage["attempt"] for stage in detail["stages"]}
    for stage, place in FOLDERS.items():
        by = folder / place / "by.txt"
        if not by.exists() or not 1 <= int(by.read_text()) <= attempts[stage]:
            faults.append(f"stage {stage} has no result of an attempt that is told of")
    if (folder / "lit").exists():
        faults.append("the dome is lit")
    ids = [event["id"] for event in events]
    if ids != sorted(set(ids)):
        faults.append("events are out of order")
    if [event["data"]["state"] for event in events if event["kind"] == "state"][-1:] != [cell.state]:
        faults.append("the last event tells of another state")
    return Cell(**{**asdict(cell), "attempts": attempts, "faults": tuple(faults)})


def run_cells(system: SmallSystem, cells: Sequence[tuple[str, str, str]]) -> Iterator[Cell]:
    """One cell after the other, on one system."""
    for part, stage, point in cells:
        yield run_cell(system, part, stage, point)


def all_cells() -> list[tuple[str, str, str]]:
    """Every part, stage and point."""
    return [(part, stage, point) for part in PARTS for stage in STAGES for point in POINTS]


def main() -> None:
    """Run all cells, print them as they end and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", action="append", choices=PARTS, help="only this part; may be repeated")
    arguments = parser.parse_args()
    cells = [cell for cell in all_cells() if not arguments.part or cell[0] in arguments.part]
    done: list[Cell] = []
    with tempfile.TemporaryDirectory() as folder, small_system(Path(folder)) as system:
        for cell in run_cells(system, cells):
            done.append(cell)
            print(f"{cell.part:10} {cell.stage:8} {cell.point:7} {cell.state:10} {cell.seconds:6.1f} s  {'; '.join(cell.faults) or 'good'}", flush=True)
            arguments.out.write_text(json.dumps([asdict(one) for one in done], indent=1) + "\n")
    good = sum(not cell.faults for cell in done)
    print(f"{good} of {len(done)} cells are good.")
    raise SystemExit(good != len(done))


if __name__ == "__main__":
    main()
