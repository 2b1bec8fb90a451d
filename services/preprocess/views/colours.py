"""Check that the frames of a camera agree on which channel is red and which is blue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from services.core.errors import CaptureInputError
from services.core.geometry import Record

SWAPPED_FACTOR = 1.5
"""Factor by which a frame's ratio of red to blue must differ from that of the frames before it for its channels to
count as swapped. Lights of one kind differ by 10 %."""
MIN_OTHERS = 2
"""Smallest number of agreeing earlier frames against which a frame is judged."""


class FrameColour(Record):
    """Ratio of red to blue over the subject in one frame."""

    file: str
    label: str
    log_red_to_blue: float


def require_like_colours(colours: Sequence[FrameColour], camera: str) -> None:
    """Refuse frames if one of them has red and blue exchanged relative to the frames before it.

    Raises:
        CaptureInputError: a frame's channels look exchanged; the message names the frame.
    """
    limit = float(np.log(SWAPPED_FACTOR))
    for number, own in enumerate(colours):
        usual = [one.log_red_to_blue for one in colours[:number]]
        if len(usual) < MIN_OTHERS or np.ptp(usual) >= limit or abs(np.median(usual)) <= limit / 2:
            continue
        ratio, middle = own.log_red_to_blue, float(np.median(usual))
        if abs(ratio - middle) > limit and abs(-ratio - middle) < limit / 2:
            raise CaptureInputError(
                f"Frame {own.file} ({own.label}) has {np.exp(ratio):.2g} times as much red as blue where"
                f" {colours[0].file} has {np.exp(middle):.2g} times; its channels look exchanged, so export it like the"
                f" others of camera {camera}."
            )
