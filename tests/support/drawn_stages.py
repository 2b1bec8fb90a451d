"""Stages that only wait, for a time given by a job's size and a random factor."""

from __future__ import annotations

import random
import time

from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.stage import StageContext, StageEvent, StageName
from services.core.store import StageWriter

SECONDS_PER_SAMPLE = 0.02
SPREAD = 0.25
"""Standard deviation of the logarithm of the random factor."""


def _last(stage: StageName, folder: str, seconds: float, context: StageContext) -> AssetManifest:
    writer, ends_s = StageWriter(context.root, folder, context.attempt), time.monotonic() + seconds
    for tenth in range(1, 11):
        while (left_s := ends_s - (10 - tenth) / 10 * seconds - time.monotonic()) > 0:
            context.raise_if_cancelled()
            time.sleep(min(left_s, 0.1))
        context.report(StageEvent(stage=stage, kind="progress", done=tenth / 10))
    record = AssetManifest(files=(), held_out_error=0.0)
    writer.publish(record)
    return record


def prepare(_spec: JobSpec, context: StageContext) -> AssetManifest:
    """Wait for a fixed time."""
    return _last("prepare", "prepared", 0.2, context)


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Wait for a fixed time and a time proportional to the samples, both times a factor drawn from the job's seed."""
    factor = random.Random(spec.seed).lognormvariate(0.0, SPREAD)
    return _last("fit", "fit", (0.3 + SECONDS_PER_SAMPLE * spec.samples_per_pixel) * factor, context)


def export(_spec: JobSpec, context: StageContext) -> AssetManifest:
    """Wait for a fixed time."""
    return _last("export", "asset", 0.1, context)
