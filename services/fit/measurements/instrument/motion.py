"""Motion of single photographs, as the preparation states its error: two shifts of each are unknowns of a tooth's fit.

A photograph that is shifted by s px shows at each pixel what the render shows s px before, so the column of a shift is
the slope of the photograph with the sign turned, under that light alone. The prior is the motion's error, and none is
estimated where the subject is stated to stand still.
"""

from __future__ import annotations

import json
from pathlib import Path

MIN_ERROR_PX = 0.05
"""Least error of a photograph's motion, in pixels of the fit, that is estimated. A shift by less changes a tooth's
image by half a per cent, which is less than photographs and renders hold of it."""
MAX_SHIFTED = 36
"""Largest number of photographs whose shifts are estimated, those of the largest errors. Each adds two derivatives to
every block, 4 MB in a block of 200,000 measurements."""


def shift_errors_px(prepared: Path, pixel_step: int) -> dict[tuple[str, str], float]:
    """Standard error of each photograph's shift along x and y, in pixels of the fit, by camera and light; only of those
    that have one of ``MIN_ERROR_PX`` or more.

    Args:
        prepared: folder of the prepared capture.
        pixel_step: edge of the fit's pixels, in pixels of the photographs.
    """
    path = prepared / "quality.json"
    images = json.loads(path.read_text())["images"] if path.is_file() else []
    found = {(one["camera"], one["light"]): (one.get("motion_error_px") or 0.0) / pixel_step for one in images}
    largest = sorted((one for one, error in found.items() if error >= MIN_ERROR_PX), key=lambda one: -found[one])
    return {photograph: found[photograph] for photograph in largest[:MAX_SHIFTED]}
