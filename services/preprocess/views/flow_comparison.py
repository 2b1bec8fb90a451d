"""Dense optical flow between two tracking frames, before and after stabilisation.

The flow uses neither the scan nor the measured motion, so the flow that remains after stabilisation is an independent
check.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
FLOW_SIDE_PX = 1500
"""Largest side of the compared images, pixels: the flow's own errors are about 0.1 px, and a larger image takes
seconds."""


@dataclass(frozen=True)
class FlowComparison:
    """Flow from the first tracking frame to the one that moved most.

    Attributes:
        frame: number of the frame that moved most.
        before, after: (h, w, 2), x and y in pixels of the photograph, at every pixel of the reduced view.
        teeth: (h, w), pixels of the reduced view that show teeth.
    """

    frame: int
    before: Image
    after: Image
    teeth: NDArray[np.bool_]


def compare_flow(
    frame: int,
    reference: NDArray[np.generic],
    moved: NDArray[np.generic],
    inner: tuple[slice, slice],
    positions: Image,
    teeth_mask: NDArray[np.bool_],
) -> FlowComparison:
    """Compute the flow to a frame as it is, and to the same frame resampled at the displaced pixels.

    Args:
        frame: number of the frame.
        reference, moved: first tracking frame and this one, each (H, W) or (H, W, C), in the window around the view.
        inner: rows and columns of the view in that window, (h, w) pixels.
        positions: (2, h, w), x and y of the displaced pixels as indices into ``moved``.
        teeth_mask: (h, w), pixels that show teeth.
    """
    import cv2

    grey = _grey(moved)
    aligned = cv2.remap(grey, positions[0], positions[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    factor = max(1, -(-max(teeth_mask.shape) // FLOW_SIDE_PX))
    size = max(1, teeth_mask.shape[1] // factor), max(1, teeth_mask.shape[0] // factor)
    first, second, third = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        for image in (_grey(reference)[inner], grey[inner], aligned)
    )
    teeth = cv2.resize(teeth_mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    # Scale all three images alike; with separate scales a change of exposure would appear as motion
    low, high = np.quantile(first[teeth], [0.01, 0.99]) if teeth.any() else (0.0, 1.0)
    first, second, third = (
        (255 * np.clip((image - low) / max(high - low, 1e-30), 0, 1)).astype(np.uint8)
        for image in (first, second, third)
    )
    scale = np.array([teeth_mask.shape[1] / size[0], teeth_mask.shape[0] / size[1]], dtype=np.float32)
    return FlowComparison(frame, scale * _flow(first, second), scale * _flow(first, third), teeth)


def _flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> Image:
    """Flow (h, w, 2) by dense inverse search (Kroeger et al. 2016) down to the finest scale.

    It is zero in images smaller than the method's patches.
    """
    import cv2

    if min(first.shape) < 16:
        return np.zeros((*first.shape, 2), dtype=np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)
    return np.asarray(flow.calc(first, second, None), dtype=np.float32)


def _grey(image: NDArray[np.generic]) -> Image:
    return np.asarray(image if image.ndim == 2 else image.mean(axis=-1), dtype=np.float32)
