"""A fit of blocks that last as long as its source says, spread over the workers as a real one's, and told in a file;
the other stages are toys.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

from services.core.placement import WEIGHTS
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.stage import CANCEL_FLAG, StageContext
from services.fit.execution.executors import executor
from tests.support import toy_stages

capture, prepare, export = toy_stages.capture, toy_stages.prepare, toy_stages.export
BLOCKS = "blocks.json"
"""In the folder of the source: block_s, blocks of a step, steps, pause_s between steps."""
TRACE = "trace.jsonl"
"""In the same folder: start and end of every block, Unix time, and its worker."""
ENGINE = "tests.support.broken_engine:BrokenEngine"


def block(_host: object, lasts_s: float, *_earlier: object) -> tuple[float, float, str]:
    """Hold a worker for a while."""
    from distributed import get_worker

    start_s = time.time()
    time.sleep(lasts_s)
    return start_s, time.time(), str(get_worker().address)


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Runs its steps until they are done or its source holds ``enough``."""
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
    """The blocks that a fit has told."""
    path = source / TRACE
    return [tuple(json.loads(line)) for line in path.read_text().splitlines()] if path.exists() else []
