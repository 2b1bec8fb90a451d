"""Calibration frames of a raw folder as linear light: counts above black, divided by exposure, gain and level."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.raw.frames import read_counts, read_frame
from services.core.raw.mosaic import binned
from services.core.raw.records import RawFolder, RawFrame

Image = NDArray[np.float32]
Part = tuple[slice, slice]
WHOLE: Part = (slice(None), slice(None))
PERCENTILE_VALUES = 2_000_000
"""Approximate number of a photograph's values from which percentiles are taken: those of every n-th value are those of
all, and sorting twenty million values takes longer than reading them."""
ROUNDING = 1 / 12
"""Variance in counts² of rounding to whole counts."""
LOW_PERCENTILE, HIGH_PERCENTILE = 1.0, 99.5
"""Percentiles of a photograph's grey values that become black and white for the detection of boards and charts, so that
a few glints do not darken it."""


@dataclass(frozen=True)
class Black:
    """Black level and noise of a camera without light.

    Attributes:
        counts: mean counts over the image.
        noise: standard deviation in counts of a pixel from one frame to the next, without the effect of rounding.
    """

    counts: float
    noise: float


@dataclass(frozen=True)
class Channels:
    """Light by channel in a photograph or a part of it.

    Attributes:
        values: counts above black, divided by exposure, gain and level (h, w, C).
        pixel: width of one value in pixels of the photograph: 1, or 2 for a mosaic.
        saturated: mask of the values with a saturated channel (h, w).
        first_px: column and row of the photograph at which the values begin.
    """

    values: Image
    pixel: int
    saturated: NDArray[np.bool_]
    first_px: tuple[int, int] = (0, 0)

    def centres(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the positions (N, 2) in the photograph's pixels of the centres of values, given by rows (N,) and
        columns (N,).
        """
        return np.asarray(np.stack([columns + 0.5, rows + 0.5], axis=1) * self.pixel + np.array(self.first_px))


class Photos:
    """Reader of a raw folder's frames, one at a time; black levels are measured once, at the start."""

    def __init__(self, root: Path, folder: RawFolder) -> None:
        self.root, self.folder = root, folder
        self.black = {camera.name: self._black(camera.name) for camera in folder.camera}

    def grey(self, frame: RawFrame, part: Part = WHOLE) -> Image:
        """Return the brightness (h, w) of a part of a photograph: counts above black, divided by exposure, gain and
        level, as the mean over the channels; a mosaic is interpolated.

        Parts of a mosaic begin at even rows and columns.
        """
        counts = self._above_black(frame, read_counts(self.root, self.folder, frame)[part])
        if counts.ndim == 3:
            # Add channel by channel, because NumPy's mean over a short last axis takes five times as long.
            total = counts[..., 0].copy()
            for channel in range(1, counts.shape[2]):
                total += counts[..., channel]
            return np.asarray(total / np.float32(counts.shape[2]))
        import cv2

        mosaic = self.folder.camera_named(frame.camera).mosaic
        code = getattr(cv2, f"COLOR_Bayer{mosaic}2GRAY")
        top = max(float(counts.max()), 1e-12)
        interpolated = cv2.cvtColor((np.maximum(counts, 0) / top * 65535).astype(np.uint16), code)
        return np.asarray(interpolated, dtype=np.float32) * np.float32(top / 65535)

    def channels(self, frame: RawFrame, part: Part = WHOLE) -> Channels:
        """Return the light by channel in a part of a photograph; a mosaic at half its size, without interpolation."""
        camera = self.folder.camera_named(frame.camera)
        read = read_frame(self.root, self.folder, frame)
        counts = read.counts[part]
        is_full = np.asarray(counts >= read.fullness.at(part))
        values = self._above_black(frame, counts)
        first = (part[1].start or 0, part[0].start or 0)
        if camera.mosaic == "none":
            return Channels(values, 1, np.asarray(is_full.any(axis=2)), first)
        full = binned(is_full.astype(np.float32), camera.mosaic) > 0
        return Channels(binned(values, camera.mosaic), 2, np.asarray(full.any(axis=2)), first)

    def _above_black(self, frame: RawFrame, counts: NDArray[np.generic]) -> Image:
        scale = 1 / (frame.exposure_s * frame.gain * frame.level)
        return np.asarray((counts.astype(np.float32) - np.float32(self.black[frame.camera].counts)) * np.float32(scale))

    def _black(self, camera: str) -> Black:
        frames = self.folder.frames_of(camera, "black")
        if not frames:
            return Black(0.0, 0.0)
        return black_of(read_counts(self.root, self.folder, frame) for frame in frames)


def black_of(frames: Iterable[NDArray[np.generic]]) -> Black:
    """Measure black level and noise from frames without light (H, W) or (H, W, C), one in memory at a time.

    For two or more frames the noise comes from each pixel's own variance over the frames (Welford 1962), so that a
    sensor's fixed pattern does not count as noise. For a single frame it is the standard deviation over the image. The
    variance of 1/12 from rounding to whole counts is subtracted.
    """
    mean = squares = np.zeros(())
    count = 0
    for frame in frames:
        counts, count = frame.astype(np.float32), count + 1
        off = counts - mean
        mean = mean + off / count
        squares = squares + off * (counts - mean)
    variance = float(np.var(mean)) if count == 1 else float(np.mean(squares)) / (count - 1)
    return Black(float(np.mean(mean)), max(variance - ROUNDING, 0.0) ** 0.5)


def plain_copies(grey: Image) -> Iterator[NDArray[np.uint8]]:
    """Yield a photograph (H, W) in 8 bits without the stretch of its range: as the file has it, from black to its
    largest value, and with the square root of its light, as screens show it.
    """
    share = np.clip(grey / max(float(grey.max()), 1e-12), 0, 1)
    yield np.asarray((255 * share).astype(np.uint8))
    yield np.asarray((255 * np.sqrt(share)).astype(np.uint8))


def to_eight_bit(grey: Image) -> NDArray[np.uint8]:
    """Return a photograph (H, W) in 8 bits, with its own range of brightness stretched to the full range."""
    step = max(round((grey.size / PERCENTILE_VALUES) ** 0.5), 1)
    low, high = (float(one) for one in np.percentile(grey[::step, ::step], [LOW_PERCENTILE, HIGH_PERCENTILE]))
    stretched = (grey - low) * (255 / max(high - low, 1e-12))
    return np.asarray(np.clip(stretched, 0, 255, out=stretched).astype(np.uint8))
