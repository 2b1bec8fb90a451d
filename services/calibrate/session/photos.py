"""Counts of a raw folder's calibration frames as light: black subtracted, divided by exposure, gain and level."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.raw.frames import read_counts
from services.core.raw.mosaic import binned
from services.core.raw.records import RawFolder, RawFrame

Image = NDArray[np.float32]
LOW_PERCENTILE, HIGH_PERCENTILE = 1.0, 99.5
"""Of a photograph's grey values: what is drawn black and white for the finders of boards, so that a few glints do not darken it."""


@dataclass(frozen=True)
class Black:
    """A camera without light: mean counts over the image, and the scatter of a pixel from one frame to the next."""

    counts: float
    noise: float


@dataclass(frozen=True)
class Channels:
    """Light by channel.

    Attributes:
        values: counts above black over exposure, gain and level, (h, w, C).
        pixel: edge of one value in pixels of the photograph: 1, or 2 of a mosaic.
        saturated: where some channel is full (h, w).
    """

    values: Image
    pixel: int
    saturated: NDArray[np.bool_]

    def centres(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of the photograph at the centres of values."""
        return np.stack([columns + 0.5, rows + 0.5], axis=1) * self.pixel


class Photos:
    """Reads frames one at a time; black levels are taken once."""

    def __init__(self, root: Path, folder: RawFolder) -> None:
        self.root, self.folder = root, folder
        self.black = {camera.name: self._black(camera.name) for camera in folder.camera}

    def grey(self, frame: RawFrame) -> Image:
        """Brightness (H, W) above black over exposure, gain and level; of a mosaic interpolated."""
        counts = self._above_black(frame)
        if counts.ndim == 3:
            return np.asarray(counts.mean(axis=2))
        import cv2

        mosaic = self.folder.camera_named(frame.camera).mosaic
        code = getattr(cv2, f"COLOR_Bayer{mosaic}2GRAY")
        top = max(float(counts.max()), 1e-12)
        drawn = cv2.cvtColor((np.maximum(counts, 0) / top * 65535).astype(np.uint16), code)
        return np.asarray(drawn, dtype=np.float32) * np.float32(top / 65535)

    def channels(self, frame: RawFrame) -> Channels:
        """Light by channel; a mosaic at half its size, without interpolation."""
        camera = self.folder.camera_named(frame.camera)
        counts = read_counts(self.root, self.folder, frame)
        is_full = np.asarray(counts >= (np.inf if camera.full_counts is None else camera.full_counts))
        values = self._above_black(frame, counts)
        if camera.mosaic == "none":
            return Channels(values, 1, np.asarray(is_full.any(axis=2)))
        full = binned(is_full.astype(np.float32), camera.mosaic) > 0
        return Channels(binned(values, camera.mosaic), 2, np.asarray(full.any(axis=2)))

    def _above_black(self, frame: RawFrame, counts: NDArray[np.generic] | None = None) -> Image:
        if counts is None:
            counts = read_counts(self.root, self.folder, frame)
        scale = 1 / (frame.exposure_s * frame.gain * frame.level)
        return np.asarray((counts.astype(np.float32) - np.float32(self.black[frame.camera].counts)) * np.float32(scale))

    def _black(self, camera: str) -> Black:
        frames = self.folder.frames_of(camera, "black")
        if not frames:
            return Black(0.0, 0.0)
        stack = [read_counts(self.root, self.folder, frame).astype(np.float32) for frame in frames[:8]]
        noise = float(np.std(stack[0] - stack[1])) / 2**0.5 if len(stack) > 1 else float(np.std(stack[0]))
        return Black(float(np.mean([one.mean() for one in stack])), noise)


def for_finders(grey: Image) -> NDArray[np.uint8]:
    """A photograph (H, W) in 8 bits, stretched over its own range."""
    low, high = np.percentile(grey, [LOW_PERCENTILE, HIGH_PERCENTILE])
    return np.asarray(np.clip((grey - low) / max(high - low, 1e-12), 0, 1) * 255).astype(np.uint8)
