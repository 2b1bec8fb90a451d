"""Entry points of calibration: ``run`` registers the scan of a raw folder, ``calibrate`` does a whole job of kind
calibration.
"""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from services.core.raw.registration import REGISTERED
from services.core.stage import StageEvent
from services.core.store import StageWriter

if TYPE_CHECKING:
    from services.core.raw.registration import Registration
    from services.core.records import JobSpec
    from services.core.results import AssetManifest
    from services.core.stage import StageContext

STEPS = 4
"""Number of steps whose start a calibration reports: cameras, lights, intensities and colours."""


def run(spec: JobSpec, context: StageContext) -> Registration:
    """Register the scan of ``spec.capture``, a raw folder, as ``dentine register`` does, and publish ``registered``.

    If the registration is refused, its pictures stay in the job's folder, which the message names.

    Raises:
        CaptureInputError: an input is missing or contradicts another one, or the pose is not plausible.
        MeshError: the scan cannot be made solid.
        JobCancelledError: the job was cancelled.
    """
    from services.calibrate.registration.register import PICTURES, register_folder

    assert spec.capture is not None, "only a raw folder is registered"
    context.raise_if_cancelled()
    writer, refused = StageWriter(context.root, REGISTERED, context.attempt), context.root / PICTURES
    record = register_folder(spec.capture, spec.calibration, writer.folder, refused=refused)
    for step in record.steps:
        for sentence in step.left_out:
            context.report(StageEvent(stage="register", kind="log", message=f"Left out by {step.name}: {sentence}."))
    for sentence in record.warnings:
        context.report(StageEvent(stage="register", kind="log", message=sentence))
    context.raise_if_cancelled()
    writer.publish(record)
    shutil.rmtree(refused, ignore_errors=True)
    message = (
        f"{len(record.teeth)} teeth stand in the rig, {record.misfit_mm:.3f} mm from their outlines in the median."
    )
    context.report(StageEvent(stage="register", kind="finished", done=1.0, message=message))
    return record


def calibrate(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Calibrate the rig of ``spec.capture``, a raw folder, as ``dentine calibrate`` does, and publish the record as the
    asset.

    The report lies in the job's folder, where jobs of other kinds have theirs. A calibration that exceeds its limits is
    published too, with advice on what to photograph again; jobs that name it refuse it.

    Raises:
        CaptureInputError: names the frame, board, sphere or camera that cannot be used, and the remedy.
        JobCancelledError: the job was cancelled.
    """
    from services.calibrate.session.report_page import write_report
    from services.calibrate.session.run import CALIBRATION, RESIDUALS, write_session
    from services.calibrate.session.run import calibrate as calibrate_folder
    from services.core.results import AssetManifest

    assert spec.capture is not None, "only a raw folder is calibrated"
    steps = 0

    def report_step(step: str) -> None:
        nonlocal steps
        context.raise_if_cancelled()
        context.report(StageEvent(stage="export", kind="progress", done=steps / STEPS, message=step))
        steps += 1

    context.report(StageEvent(stage="export", kind="started"))
    session = calibrate_folder(spec.capture, report_step)
    for sentence in session.judgement.suspicions:
        context.report(StageEvent(stage="export", kind="log", message=sentence))
    writer = StageWriter(context.root, "asset", context.attempt)
    write_session(session, writer.folder)
    write_report(session, context.root)
    broken = session.judgement.broken
    manifest = AssetManifest(
        files=(CALIBRATION, RESIDUALS),
        converged=not broken,
        advice=session.judgement.advice,
    )
    writer.publish(manifest)
    broken_limits = f"{len(broken)} limits are not kept. " if broken else ""
    context.report(
        StageEvent(stage="export", kind="finished", done=1.0, message=broken_limits + session.judgement.advice)
    )
    return manifest
