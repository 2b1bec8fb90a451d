"""Optical flow of one camera before and after stabilisation, in numbers and two small pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.preprocess.quality.images import PICTURE_PX, CameraFlow
from services.preprocess.views.flow_comparison import FlowComparison

Image = NDArray[np.float32]
MIN_SCALE_PX = 0.5
"""Smallest flow, pixels, that is drawn in full colour. Smaller flow is mostly the method's own error and would look
like motion."""


def camera_flow(camera: str, flow: FlowComparison) -> CameraFlow | None:
    """Median and 95th percentile of a camera's flow over the teeth; None if no pixel shows a tooth."""
    if not flow.teeth.any():
        return None
    lengths = [np.linalg.norm(field[flow.teeth], axis=-1) for field in (flow.before, flow.after)]
    before, after = ((float(np.median(one)), float(np.quantile(one, 0.95))) for one in lengths)
    return CameraFlow(
        camera=camera, frame=flow.frame, before_px=before, after_px=after, scale_px=max(before[1], MIN_SCALE_PX)
    )


def write_flow(folder: Path, flow: FlowComparison, numbers: CameraFlow) -> None:
    """Write the flow as ``<camera>_before.png`` and ``<camera>_after.png``.

    Hue shows the direction. Full saturation means a flow of ``scale_px`` or more, white means no flow.
    """
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    step = max(1, -(-max(flow.teeth.shape) // PICTURE_PX))
    for name, field in (("before", flow.before), ("after", flow.after)):
        picture = _picture(field[::step, ::step], flow.teeth[::step, ::step], numbers.scale_px)
        cv2.imwrite(str(folder / f"{numbers.camera}_{name}.png"), picture)


def _picture(field: Image, teeth: NDArray[np.bool_], scale_px: float) -> NDArray[np.uint8]:
    """Picture (h, w, 3) of a flow field (h, w, 2) in blue, green, red; black beside the teeth."""
    import cv2

    length, angle_deg = cv2.cartToPolar(field[..., 0], field[..., 1], angleInDegrees=True)
    # Convert to OpenCV's 8-bit hue, which counts in steps of two degrees
    hue, colour = angle_deg / 2 % 180, 255 * np.minimum(length / scale_px, 1)
    bright = np.where(teeth, np.float32(255), np.float32(0))
    return np.asarray(
        cv2.cvtColor(np.stack([hue, colour, bright], axis=-1).astype(np.uint8), cv2.COLOR_HSV2BGR), dtype=np.uint8
    )
