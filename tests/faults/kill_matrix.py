"""Matrix of faults: each part of the service fails in each stage of a job; kills strike also at the stages' boundaries.

python -m tests.faults.kill_matrix --json matrix.json

A job of toy stages runs through the real API, database, scheduler and workers, each on a host of its own. It is held at
one point, one fault strikes, the job continues, and parts that ended are started again, as an orchestrator does. A cell
is good if the job succeeded, every stage was published once and by a known attempt, the published files are intact, the
dome is dark, the events are complete and in order, and there is one job for every submission. At the end all stores are
checked once more, because an abandoned attempt may write late.
"""

from __future__ import annotations

import argparse
import json
import secrets
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from services.core.errors import StoreError
from services.core.results import AssetManifest
from services.core.store import open_stage
from tests.faults.strikes import FAULTS, Held
from tests.support.small_system import SmallSystem, small_system

STAGES = ("capture", "prepare", "fit", "export")
POINTS = ("start", "middle", "end")
KILLS = ("api", "scheduler", "stage", "host", "database")
FOLDERS = {"capture": "capture", "prepare": "prepared", "fit": "fit", "export": "asset"}


@dataclass(frozen=True)
class Cell:
    """One fault at one point of one stage, and the result of the job."""

    fault: str
    stage: str
    point: str
    job: str
    state: str
    attempts: dict[str, int]
    """Number of starts of each stage."""
    seconds: float
    """Time from the fault to the job's end."""
    faults: tuple[str, ...]
    """Sentences about errors of the result; empty if the cell is good."""


def run_cell(system: SmallSystem, fault: str, stage: str, point: str) -> Cell:
    """Run one job through one fault."""
    key = secrets.token_hex(4)
    steering = system.data.parent / f"mouth-{key}" / "steering"
    steering.mkdir(parents=True)
    hold, reached = steering / f"hold-{stage}-{point}", steering / f"at-{stage}-{point}"
    hold.touch()
    spec = {"workers": 1, "rig": {"mouth": str(steering.parent)}}
    with system.client() as client:
        job = client.post("/v1/jobs", json=spec, headers={"Idempotency-Key": key}).raise_for_status().json()["id"]
    system.acknowledged.append(job)
    system.wait_until(reached.exists, f"stage {stage} never reached its {point}")
    held = Held(system, job, key, spec, stage, reached, _pid(reached))

    began = time.monotonic()
    with FAULTS[fault](held):
        hold.unlink()
    system.wait_until(held.ended, f"job {job} did not end after {fault} at the {point} of {stage}")
    return _judge(held, steering, Cell(fault, stage, point, job, "", {}, time.monotonic() - began, ()))


def _pid(reached: Path) -> int:
    while not (text := reached.read_text()):
        time.sleep(0.01)
    return int(text)


def _judge(held: Held, steering: Path, cell: Cell) -> Cell:
    detail = held.get(f"/v1/jobs/{held.job}")
    attempts = {stage["stage"]: stage["attempt"] for stage in detail["stages"]}
    events = _events(held)
    faults = _store_faults(held.system.data / "jobs" / held.job, attempts)
    if detail["state"] != "SUCCEEDED":
        faults.append(f"the job ended {detail['state']}: {detail['failure']}")
    published = Counter((steering / "publications.txt").read_text().split())
    faults += [f"stage {stage} was published {published[stage]} times" for stage in STAGES if published[stage] != 1]
    if (steering / "lit").exists():
        faults.append("the dome is lit")
    ids = [event["id"] for event in events]
    if ids != sorted(set(ids)):
        faults.append("events are out of order")
    if [event["data"]["state"] for event in events if event["kind"] == "state"][-1:] != [detail["state"]]:
        faults.append("the last event tells of another state")
    listed = {job["id"]: job["state"] for job in held.get("/v1/jobs?limit=500")["jobs"]}
    if listed != dict.fromkeys(held.system.acknowledged, "SUCCEEDED"):
        faults.append(f"{len(held.system.acknowledged)} jobs were acknowledged, and there are {listed}")
    return replace(cell, state=detail["state"], attempts=attempts, faults=tuple(faults))


def _events(held: Held) -> list[dict[str, Any]]:
    """All events of a job, as the stream replays them."""
    with held.system.client() as client:
        lines = client.get(f"/v1/jobs/{held.job}/events").text.splitlines()
    told = (json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: {"))
    return [event for event in told if "id" in event]


def _store_faults(folder: Path, attempts: dict[str, int]) -> list[str]:
    faults = []
    for stage, place in FOLDERS.items():
        try:
            published, _ = open_stage(folder, place, AssetManifest)
        except StoreError as problem:
            faults.append(problem.message)
            continue
        if not 1 <= int((published / "by.txt").read_text()) <= attempts[stage]:
            faults.append(f"stage {stage} has a result of an attempt that nobody tells of")
    return faults


def run_cells(system: SmallSystem, cells: Sequence[tuple[str, str, str]]) -> Iterator[Cell]:
    """Run cells one after the other on one system."""
    for fault, stage, point in cells:
        yield run_cell(system, fault, stage, point)


def all_cells() -> list[tuple[str, str, str]]:
    """All cells as (fault, stage, point): every kill at every point of every stage, every other fault in its middle."""
    kills = [(part, stage, point) for part in KILLS for stage in STAGES for point in POINTS]
    return kills + [(fault, stage, "middle") for fault in FAULTS if fault not in KILLS for stage in STAGES]


def main() -> None:
    """Run the cells; print each when it ends, and write all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--fault", action="append", choices=tuple(FAULTS), help="only this one; may be repeated")
    parser.add_argument("--stage", action="append", choices=STAGES, help="only in this stage; may be repeated")
    arguments = parser.parse_args()
    cells = [
        cell
        for cell in all_cells()
        if (not arguments.fault or cell[0] in arguments.fault) and (not arguments.stage or cell[1] in arguments.stage)
    ]
    done: list[Cell] = []
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        small_system(Path(folder), on_hosts=True) as system,
    ):
        for cell in run_cells(system, cells):
            done.append(cell)
            print(
                f"{cell.fault:21} {cell.stage:8} {cell.point:7} {cell.state:10} {cell.seconds:6.1f} s "
                f" {'; '.join(cell.faults) or 'good'}",
                flush=True,
            )
            arguments.json.write_text(json.dumps([asdict(one) for one in done], indent=1) + "\n")
        late = [fault for cell in done for fault in _store_faults(system.data / "jobs" / cell.job, cell.attempts)]
    good = sum(not cell.faults for cell in done)
    print(f"{good} of {len(done)} cells are good; {len(late)} stores changed afterwards.")
    raise SystemExit(good != len(done) or bool(late))


if __name__ == "__main__":
    main()
