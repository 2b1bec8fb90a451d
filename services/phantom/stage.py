"""The stage that makes the virtual mouth of a demonstration."""

from __future__ import annotations

from services.core.records import FolderCapture, JobSpec
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, read_record
from services.phantom.demo import DESCRIPTION, make_demo_mouth


def run(spec: JobSpec, context: StageContext) -> FolderCapture:
    """Publish ``phantom/``, the virtual incisor that a demonstration's simulated rig photographs.

    Finished mouths are kept in the folder ``spec.rig.mouth``, unless it is only the demonstration's placeholder.

    Raises:
        CrashError: the incisor could not be rendered. JobCancelledError: the job was cancelled, also during a kernel.
    """
    done = -1.0

    def report_fraction(fraction: float) -> None:
        nonlocal done
        context.raise_if_cancelled()
        if fraction > done:
            done = fraction
            context.report(
                StageEvent(stage="phantom", kind="progress", done=done, message="A virtual incisor is being rendered.")
            )

    context.report(StageEvent(stage="phantom", kind="started"))
    context.raise_if_cancelled()
    writer = StageWriter(context.root, "phantom", context.attempt)
    cache = spec.rig.mouth if spec.rig is not None and not spec.is_demo else None
    is_new = make_demo_mouth(writer.folder, cache, report_fraction)
    description = read_record(writer.folder / DESCRIPTION, FolderCapture)
    writer.publish(description)
    how = "rendered" if is_new else "taken from an earlier demonstration"
    context.report(StageEvent(stage="phantom", kind="finished", done=1.0, message=f"A virtual incisor was {how}."))
    return description
