"""Stages that publish tiny results, for tests of the code around the stages.

Files in the job's folder steer them. If the folder that the job names has a subfolder ``steering``, some of these files
are read there instead: it exists before the job, and can be written whatever happens to the store. The stages record
their progress in the same place.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from services.core.errors import CaptureInputError, JobCancelledError
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.stage import StageContext, StageEvent, StageName
from services.core.store import StageWriter, require_intact, write_atomic
from services.pipeline.event_log import EventAddress
from services.pipeline.stage_task import StageTask
from services.pipeline.stages import stages_of

DOORS: dict[StageName, str] = {
    stage: f"tests.support.toy_stages:{stage}" for stage in ("phantom", "capture", "prepare", "fit", "export")
}


def run_here(spec: JobSpec, root: Path, events: EventAddress) -> None:
    """Run a job's stages in this thread, for tests that need no workers: the ``run`` of ``create_app``."""
    for stage in stages_of(spec):
        StageTask(stage, DOORS[stage], spec, root.resolve(), events)()


def _steering(spec: JobSpec, context: StageContext) -> Path:
    source = spec.rig.mouth if spec.rig else spec.capture
    return source / "steering" if source is not None and (source / "steering").is_dir() else context.root


def _publish(stage: StageName, folder: str, spec: JobSpec, context: StageContext) -> AssetManifest:
    writer = StageWriter(context.root, folder, context.attempt)
    (writer.folder / "by.txt").write_text(f"{context.attempt}\n")
    record = AssetManifest(files=("by.txt",), held_out_error=0.04)
    if stage != "capture":
        _reach(spec, context, stage, "middle")
    writer.publish(record)
    with (_steering(spec, context) / "publications.txt").open("a") as stream:
        stream.write(f"{stage}\n")
    _reach(spec, context, stage, "end")
    return record


def _reach(spec: JobSpec, context: StageContext, stage: StageName, point: str) -> None:
    # Writes the point reached and the process id to a file, and waits there while a file ``hold-…`` exists.
    steering = _steering(spec, context)
    write_atomic(steering / f"at-{stage}-{point}", str(os.getpid()).encode())
    while (steering / f"hold-{stage}-{point}").exists():
        context.raise_if_cancelled()
        time.sleep(0.02)


def phantom(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Publish a phantom mouth."""
    _reach(spec, context, "phantom", "start")
    return _publish("phantom", "phantom", spec, context)


def capture(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Light a dome (create the file ``lit``) and darken it on every exit; wait while ``hold-capture`` exists."""
    _reach(spec, context, "capture", "start")
    lit = _steering(spec, context) / "lit"
    lit.touch()
    try:
        while (context.root / "hold-capture").exists():
            context.raise_if_cancelled()
            time.sleep(0.02)
        _reach(spec, context, "capture", "middle")
    except JobCancelledError:
        time.sleep(0.2)
        raise
    finally:
        lit.unlink(missing_ok=True)
    return _publish("capture", "capture", spec, context)


def prepare(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Fail with an error of the capture's input while ``bad-input`` exists."""
    _reach(spec, context, "prepare", "start")
    if (context.root / "bad-input").exists():
        raise CaptureInputError("Frame c0_l3.npy is missing from the capture; copy it there.")
    return _publish("prepare", "prepared", spec, context)


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Check the preparation and report ten steps. ``kill-fit`` makes the first attempt kill its worker,
    ``always-kill`` every attempt; while ``deaf-fit`` exists, the fit ignores a cancel.
    """
    _reach(spec, context, "fit", "start")
    require_intact(context.root, "prepared")
    for step in range(10):
        data = {
            "channel": "green",
            "step": step,
            "loss": 0.5**step,
            "held_out_error": 0.6**step,
            "held_out_se": 0.002,
            "parameters": {"enamel.sigma": 4.0},
        }
        context.report(StageEvent(stage="fit", kind="step", message=f"Step {step}.", done=(step + 1) / 10, data=data))
        if step == 5 and (
            (context.root / "always-kill").exists() or ((context.root / "kill-fit").exists() and context.attempt == 1)
        ):
            os.kill(os.getpid(), signal.SIGKILL)
        while (context.root / "deaf-fit").exists():
            time.sleep(0.02)
        while (context.root / "hold-fit").exists():
            context.raise_if_cancelled()
            time.sleep(0.02)
        context.raise_if_cancelled()
    return _publish("fit", "fit", spec, context)


def export(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Publish an asset."""
    _reach(spec, context, "export", "start")
    (context.root / "report.html").write_text("<!doctype html><title>report</title>")
    return _publish("export", "asset", spec, context)


def needy(_spec: JobSpec, _context: StageContext) -> AssetManifest:
    """Import a package that does not exist."""
    import no_such_package  # type: ignore[import-not-found]  # it is missing on purpose

    return no_such_package.publish()
