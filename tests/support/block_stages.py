"""A fit whose blocks last as long as a file in its capture's folder says. They are spread over the workers like the
blocks of a real fit, and their times are written to a file. The other stages are those of ``toy_stages``.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

from services.core.placement import WEIGHTS
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.stage import CANCEL_FLAG, StageContext
from services.tasks.executors import executor
from tests.support import toy_stages

capture, prepare, export = toy_stages.capture, toy_stages.prepare, toy_stages.export
BLOCKS = "blocks.json"
"""Name of the file in the capture's folder that gives the seconds of a block (``block_s``), the blocks of a step
(``blocks``), the number of steps (``steps``) and the pause between steps in seconds (``pause_s``)."""
TRACE = "trace.jsonl"
"""Name of the file in the same folder that receives one line per block: start and end in Unix time, and the address of
the worker."""
ENGINE = "tests.support.broken_engine:BrokenEngine"


def block(_host: object, lasts_s: float, *_earlier: object) -> tuple[float, float, str]:
    """Occupy a worker for a time; returns start and end in Unix time, and the worker's address."""
    from distributed import get_worker

    start_s = time.time()
    time.sleep(lasts_s)
    return start_s, time.time(), str(get_worker().address)


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Run the steps until all are done or the capture's folder holds a file ``enough``."""
    assert spec.capture is not None
    wanted = json.loads((spec.capture / BLOCKS).read_text())
    with (
        executor(context.root / CANCEL_FLAG, ENGINE, "blocks", WEIGHTS[spec.priority]) as run_on,
        (spec.capture / TRACE).open("a") as trace,
    ):
        for step in range(wanted["steps"]):
            context.raise_if_cancelled()
            if (spec.capture / "enough").exists():
                break
            pending = [run_on.submit(f"{step}-{k}", block, wanted["block_s"]) for k in range(wanted["blocks"])]
            for row in run_on.gather(pending):
                trace.write(json.dumps(row) + "\n")
            trace.flush()
            time.sleep(wanted["pause_s"])
    return toy_stages.fit(spec, context)


def read_trace(source: Path) -> list[tuple[float, float, str]]:
    """Read start, end (Unix time) and worker of every block that a fit has written so far."""
    path = source / TRACE
    return [tuple(json.loads(line)) for line in path.read_text().splitlines()] if path.exists() else []
