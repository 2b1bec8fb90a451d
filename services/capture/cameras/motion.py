"""Motion of the simulated subject: a slow drift with a little smooth warp, known exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WARP_SHARE = 0.2
"""Fraction of the largest displacement that the warp contributes; the drift contributes the rest."""
SWAY_SHARE = 0.3
"""Amplitude of the sway across the drift, as a fraction of the drift."""


@dataclass(frozen=True)
class SubjectMotion:
    """Displacement fields over the frames of one capture.

    Pixel p of a frame shows the still image at ``p + flow_px(p)``. The field is zero up to the reference frame, changes
    smoothly with the frame's number, and never exceeds ``motion_px`` anywhere.

    Attributes:
        motion_px: upper bound of the displacement, pixels.
        reference: number of the first lit frame.
        last: number of the last frame.
        seed: seed of the random directions and phases.
    """

    motion_px: float
    reference: int
    last: int
    seed: int

    def flow_px(self, frame: int, camera: int, height: int, width: int) -> NDArray[np.float64]:
        """Ground truth (height, width, 2): x and y displacement of each pixel relative to the still image, pixels."""
        field = np.zeros((height, width, 2))
        if self.motion_px == 0 or frame <= self.reference:
            return field
        progress = (frame - self.reference) / max(self.last - self.reference, 1)
        direction, phase_x, phase_y = np.random.default_rng([self.seed, camera, 1]).uniform(0, 2 * math.pi, 3)

        # Drift along one direction with a sway across it; scale the norm to at most 1.
        along, across = math.sin(math.pi / 2 * progress), SWAY_SHARE * math.sin(2 * math.pi * progress)
        drift = np.array(
            [
                along * math.cos(direction) - across * math.sin(direction),
                along * math.sin(direction) + across * math.cos(direction),
            ]
        )
        drift /= math.hypot(1, SWAY_SHARE)

        # Warp by one wave across the image; the norm of (cos, cos)/√2 is at most 1.
        y, x = (np.arange(height)[:, None] + 0.5) / height, (np.arange(width)[None, :] + 0.5) / width
        warp = (
            along
            * np.stack([np.cos(math.pi * (x + y) + phase_x), np.cos(math.pi * (x - y) + phase_y)], axis=-1)
            / math.sqrt(2)
        )
        return self.motion_px * ((1 - WARP_SHARE) * drift + WARP_SHARE * warp)


def resample(image: NDArray[np.float32], flow_px: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sample an image (height, width, channel) at each pixel plus its displacement (height, width, 2).

    Catmull-Rom interpolation (Keys 1981, a = -1/2), clamped at the border and at zero.
    """
    if not flow_px.any():
        return image
    height, width, _ = image.shape
    x, y = np.arange(width)[None, :] + flow_px[..., 0], np.arange(height)[:, None] + flow_px[..., 1]
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    weights_x, weights_y = _catmull_rom(x - column), _catmull_rom(y - row)
    result = np.zeros(image.shape, dtype=np.float64)
    for j in range(4):
        rows = np.clip(row + j - 1, 0, height - 1)
        for i in range(4):
            columns = np.clip(column + i - 1, 0, width - 1)
            result += (weights_y[j] * weights_x[i])[..., None] * image[rows, columns]
    return np.maximum(result, 0).astype(np.float32)


def _catmull_rom(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Weights of the samples at -1, 0, 1, 2 for a position t in [0, 1)."""
    return (
        ((-t + 2) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((-3 * t + 4) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    )
