"""The register stage: the scan of a raw folder in, teeth and gums where they stand in the rig out."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from services.core.raw.registration import REGISTERED
from services.core.stage import StageEvent
from services.core.store import StageWriter

if TYPE_CHECKING:
    from services.core.raw.registration import Registration
    from services.core.records import JobSpec
    from services.core.stage import StageContext


def run(spec: JobSpec, context: StageContext) -> Registration:
    """Register the scan of ``spec.capture``, a raw folder, as ``dentine register`` does, and publish ``registered``.

    Pictures of a refusal stay in the job's folder, which the message names.

    Raises:
        CaptureInputError: something is missing or contradicts, or the pose is not to be believed. MeshError: the scan cannot be
            made solid. JobCancelledError.
    """
    from services.calibrate.registration.register import PICTURES, register_folder

    assert spec.capture is not None, "only a raw folder is registered"
    context.raise_if_cancelled()
    writer, refused = StageWriter(context.root, REGISTERED, context.attempt), context.root / PICTURES
    record = register_folder(spec.capture, spec.calibration, writer.folder, refused=refused)
    for step in record.steps:
        for told in step.left_out:
            context.report(StageEvent(stage="register", kind="log", message=f"Left out by {step.name}: {told}."))
    context.raise_if_cancelled()
    writer.publish(record)
    shutil.rmtree(refused, ignore_errors=True)
    message = (
        f"{len(record.teeth)} teeth stand in the rig, {record.misfit_mm:.3f} mm from their outlines in the median."
    )
    context.report(StageEvent(stage="register", kind="finished", done=1.0, message=message))
    return record
