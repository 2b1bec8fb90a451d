"""The scan's pose by its landmarks, for tests that expect a plausible one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from services.calibrate.registration.landmarks import Click, fit_landmarks
from services.calibrate.registration.pose import Floats, PoseStep
from services.core.errors import CaptureInputError
from services.core.geometry import Camera


def pose_from_landmarks(cameras: Mapping[str, Camera], clicks: Sequence[Click], centre_mm: Floats) -> PoseStep:
    """The pose; clicks that contradict each other raise as a registration does.

    Raises:
        CaptureInputError: the clicks are too few, lie on one line, or contradict each other.
    """
    step, contradiction = fit_landmarks(cameras, clicks, centre_mm)
    if contradiction is not None:
        raise CaptureInputError(contradiction)
    return step
