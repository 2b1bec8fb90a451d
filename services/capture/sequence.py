"""Execution of a plan, frame by frame: light, settle, expose, read, dark, store."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.capture.cameras.protocol import Cameras
from services.capture.dome.protocol import Dome, Rgb
from services.capture.frames import FrameStore
from services.capture.plan import PlannedFrame, shortest_s
from services.core.results import FrameRecord
from services.core.stage import StageContext, StageEvent

CLIPPED_FRACTION = 0.01
"""Largest fraction of clipped pixels of a camera that is not reported."""


def capture_frames(
    plan: Sequence[PlannedFrame],
    lights: Sequence[str],
    dome: Dome,
    cameras: Cameras,
    settle_s: float,
    store: FrameStore,
    context: StageContext,
) -> None:
    """Expose and store every planned frame that is not acknowledged yet.

    The lights are dark between two frames: during storage, during the check for a cancel, and after any exception.

    Args:
        plan: all frames of the capture.
        lights: names of the lights by index.
        dome: the dome. cameras: the cameras.
        settle_s: time between switching on a light and the exposure, seconds.
        store: storage of the frames.
        context: context of the stage.

    Raises:
        JobCancelledError, RigError, StoreError: acknowledged frames are kept, and a later attempt resumes after them.
    """
    missing = [frame for frame in plan if frame.index not in store.acknowledged]
    if len(missing) < len(plan):
        done = len(plan) - len(missing)
        context.report(
            StageEvent(
                stage="capture",
                kind="log",
                message=f"Resuming: {done} of {len(plan)} frames were already acknowledged.",
            )
        )
    began_s = time.monotonic()
    resumed_at_s = max((frame.time_s for frame in store.acknowledged.values()), default=0.0)
    for count, frame in enumerate(missing, start=1):
        context.raise_if_cancelled()
        name = None if frame.light is None else lights[frame.light]
        time_s = resumed_at_s + time.monotonic() - began_s
        readback, images = expose(frame, dome, cameras, settle_s)
        record = FrameRecord(
            index=frame.index,
            kind=frame.kind,
            light=name,
            exposure_s=frame.exposure_s,
            level=frame.level,
            time_s=time_s,
            readback=readback,
        )
        store.store(record, images)
        remaining_s = max(
            (time.monotonic() - began_s) / count * (len(missing) - count),
            shortest_s(missing[count:], dome.flash_interval_s),
        )
        context.report(
            StageEvent(
                stage="capture",
                kind="progress",
                message=(
                    f"Frame {frame.index + 1} of {len(plan)}:"
                    f" {f'light {name}' if name else frame.kind}{_clipping(images, cameras)}"
                ),
                done=len(store.acknowledged) / len(plan),
                data={"frame": frame.index, "kind": frame.kind, "light": name, "remaining_s": round(remaining_s, 3)},
            )
        )


def expose(
    frame: PlannedFrame, dome: Dome, cameras: Cameras, settle_s: float
) -> tuple[Rgb, tuple[NDArray[np.uint16], ...]]:
    """Make one exposure of all cameras; the dome is dark before and after.

    Returns:
        The levels read back, and the counts (height, width, channel) of each camera.
    """
    try:
        cameras.arm(frame.exposure_s, frame.index)
        if frame.kind != "black":
            dome.light(frame.light, frame.level, frame.on_s)
        dome.pause(settle_s)
        dome.trigger()
        images = cameras.read()
        # Check that the light lasted through the exposure: if a watchdog or strobe ended it early, the frame is
        # worthless.
        readback = dome.confirm()
    finally:
        dome.dark()
    return readback, images


def _clipping(images: Sequence[NDArray[np.uint16]], cameras: Cameras) -> str:
    fraction = max(clipped_fraction(image, cameras.bits) for image in images)
    return (
        f"; {fraction:.1%} of a camera's pixels are clipped, lower rig.level or rig.exposure_s"
        if fraction > CLIPPED_FRACTION
        else ""
    )


def clipped_fraction(image: NDArray[np.uint16], bits: int) -> float:
    """Fraction of an image's pixels (height, width, channel) with a channel at the converter's largest count."""
    return float((image >= 2**bits - 1).any(axis=-1).mean())
