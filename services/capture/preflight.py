"""Checks that take seconds to a minute, made before a capture while the subject sits in the dome."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from services.capture.cameras.protocol import Cameras
from services.capture.dome.protocol import Dome
from services.capture.plan import PlannedFrame, preflight_frames
from services.capture.sequence import CLIPPED_FRACTION, clipped_fraction, expose
from services.core.errors import RigError
from services.core.records import RigSpec

BLACK_TOLERANCE = 0.005
"""Largest deviation of a black frame's mean from the black level, as a fraction of full scale."""


def preflight(
    plan: Sequence[PlannedFrame], dome: Dome, cameras: Cameras, rig: RigSpec, raise_if_cancelled: Callable[[], None]
) -> tuple[str, ...]:
    """Switch on every light for a moment, as often as the dome may flash, then expose one black and one lit frame.

    Args:
        plan: planned frames of the capture.
        dome: the dome. cameras: the cameras.
        rig: description of the rig.
        raise_if_cancelled: called in the dark before every light and at the end; an exception from it ends the
            preflight.

    Returns:
        Sentences about settings that the operator may want to correct; empty if there are none.

    Raises:
        RigError: a light does not emit as commanded, or the black level is wrong by more than 0.5 % of full scale.
    """
    *flashes, lit = preflight_frames(plan)
    for flash in flashes:
        raise_if_cancelled()
        dome.light(flash.light, flash.level, flash.on_s)
        dome.dark()

    black = next(frame for frame in plan if frame.kind == "black")
    full_scale = 2**cameras.bits - 1
    for camera, image in enumerate(expose(black, dome, cameras, 0.0)[1]):
        offset = abs(float(image.mean()) - cameras.black_level)
        if offset > BLACK_TOLERANCE * full_scale:
            raise RigError(
                f"Camera {camera} reads {image.mean():.1f} counts in the dark instead of {cameras.black_level}; darken"
                " the room or correct the black level."
            )

    raise_if_cancelled()
    findings = []
    images = expose(lit, dome, cameras, rig.settle_s)[1]
    raise_if_cancelled()
    for camera, image in enumerate(images):
        fraction = clipped_fraction(image, cameras.bits)
        if fraction > CLIPPED_FRACTION:
            findings.append(
                f"Camera {camera} clips {fraction:.1%} of its pixels in a {lit.kind} frame; lower rig.level or"
                " rig.exposure_s."
            )
        if float(image.max()) - cameras.black_level < 2 * BLACK_TOLERANCE * full_scale:
            findings.append(f"Camera {camera} sees no light in a {lit.kind} frame; open its shutter or check its aim.")
    return tuple(findings)
