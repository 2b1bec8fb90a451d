"""Outlines of teeth as a camera sees them at a pose: points on the surface, with the direction across the outline in
the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.visibility import NOTHING, visible_surfaces
from services.calibrate.registration.pose import Floats
from services.core.geometry import Camera, Mesh

SMOOTH_PX = 1.5
"""Width of the Gaussian that smooths a tooth's mask before its gradient gives the direction across the outline."""
MARGIN_PX = 6
"""Margin around a tooth's bounding box, so that the smoothing sees all of its mask."""


@dataclass(frozen=True)
class Contour:
    """N points of outlines in one camera."""

    points_mm: Floats
    """Positions (N, 3) in the rig, on the nearer surface."""
    pixels: Floats
    """Positions (N, 2) in the image, pixel centres at half-integers."""
    outward: Floats
    """Unit vectors (N, 2) in the image that point out of the tooth."""
    tooth: NDArray[np.int64]
    """Number of the tooth (N,)."""
    between: NDArray[np.bool_]
    """True where another tooth lies on the other side (N,)."""
    gums: NDArray[np.bool_]
    """True where an occluder, such as gums, lies on the other side (N,)."""


def tooth_contours(
    camera: Camera, teeth: Sequence[Mesh], occluders: Sequence[Mesh] = ()
) -> tuple[Contour, NDArray[np.int16]]:
    """Return the outlines between pixels of a tooth and pixels of anything else, and the number (H, W) of the tooth
    that each pixel shows, -1 where it shows none.

    An outline runs midway between the two pixels' centres, so that it has no mean offset from the true outline.
    """
    visible = visible_surfaces(camera, [*teeth, *occluders])
    label, depth = visible.mesh, visible.depth_mm
    teeth_alone = np.where(label < len(teeth), label, NOTHING).astype(np.int16)
    parts = [_steps(label, depth, teeth_alone, axis) for axis in (0, 1)]
    x, y, nearer, tooth, between, gums = (np.concatenate([part[k] for part in parts]) for k in range(6))
    outward = np.zeros((len(x), 2))
    for number in np.unique(tooth):
        own = tooth == number
        outward[own] = _outward(teeth_alone == number, x[own], y[own])
    origin, direction = camera.rays(x, y)
    # Depth is measured along the camera's axis, so divide it by the ray's component along this axis.
    along = direction @ np.asarray(camera.camera_from_world)[2, :3]
    points = origin + direction * (nearer / along)[:, None]
    good = np.isfinite(outward).all(axis=1)
    contour = Contour(
        points[good], np.stack([x, y], axis=1)[good], outward[good], tooth[good], between[good], gums[good]
    )
    return contour, teeth_alone


def _steps(
    label: NDArray[np.int16], depth: Floats, teeth: NDArray[np.int16], axis: int
) -> tuple[Floats, Floats, Floats, NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    # Find pairs of neighbouring pixels that show different things, at least one of them a tooth.
    low = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
    high = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
    one, two = teeth[low], teeth[high]
    row, column = np.nonzero((one != two) & (label[low] != label[high]))
    first, second = one[row, column], two[row, column]
    depth_one, depth_two = depth[low][row, column], depth[high][row, column]
    between = (first >= 0) & (second >= 0)
    own = np.where(between, np.where(depth_one <= depth_two, first, second), np.maximum(first, second))
    x = column + (0.5 if axis == 0 else 1.0)
    y = row + (1.0 if axis == 0 else 0.5)
    nearer = np.minimum(depth_one, depth_two).astype(np.float64)
    gums = np.maximum(label[low][row, column], label[high][row, column]) > teeth.max()
    return x.astype(np.float64), y.astype(np.float64), nearer, own.astype(np.int64), between, gums


def _outward(mask: NDArray[np.bool_], x: Floats, y: Floats) -> Floats:
    import cv2

    top, left = max(int(y.min()) - MARGIN_PX, 0), max(int(x.min()) - MARGIN_PX, 0)
    box = mask[top : int(y.max()) + MARGIN_PX, left : int(x.max()) + MARGIN_PX].astype(np.float32)
    smooth = cv2.GaussianBlur(box, (0, 0), SMOOTH_PX)
    slope = [cv2.Sobel(smooth, cv2.CV_32F, dx, dy) for dx, dy in ((1, 0), (0, 1))]
    at_x, at_y = (x - left - 0.5).astype(np.float32)[:, None], (y - top - 0.5).astype(np.float32)[:, None]
    found = -np.concatenate([cv2.remap(one, at_x, at_y, cv2.INTER_LINEAR) for one in slope], axis=1).astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))
