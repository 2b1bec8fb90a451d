"""Toy stages whose fit goes on at a pace.

With solver = adam it waits for ``go`` in the job's folder and then takes ``adam_steps`` steps, ``adam_rate`` seconds
apart.
"""

from __future__ import annotations

import time

from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.stage import StageContext, StageEvent, StageName
from tests.support import toy_stages

DOORS: dict[StageName, str] = toy_stages.DOORS | {"fit": "tests.load.stages:fit"}
GO = "go"


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """The toy fit, after the paced steps."""
    if spec.solver == "adam":
        while not (context.root / GO).exists():
            context.raise_if_cancelled()
            time.sleep(0.02)
        for step in range(1, spec.adam_steps + 1):
            data = {
                "channel": "green",
                "step": step,
                "loss": 0.99**step,
                "held_out_error": 0.99**step,
                "parameters": {"enamel.sigma": 4.0},
            }
            context.report(
                StageEvent(stage="fit", kind="step", message=f"Step {step}.", done=step / spec.adam_steps, data=data)
            )
            time.sleep(spec.adam_rate)
    return toy_stages.fit(spec, context)
