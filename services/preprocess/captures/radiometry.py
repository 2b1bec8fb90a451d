"""Conversion of counts to radiance: black, gain, light level, noise, saturation, and exposures of one light merged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.core.results import CaptureManifest, FrameRecord

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Radiometry:
    """Response of one camera, linear above its measured black.

    Attributes:
        black: (H, W, C) mean of the black frames, counts.
        black_frames: number of black frames averaged.
        manifest: record with the sensor's gain, range and noise.
    """

    black: Image
    black_frames: int
    manifest: CaptureManifest

    def at(self, rows: slice, columns: slice) -> Radiometry:
        """The same response for a part of the image."""
        return replace(self, black=self.black[rows, columns])

    def radiance(self, counts: NDArray[np.uint16], frame: FrameRecord) -> tuple[Image, Image, BoolArray]:
        """Radiance scaled to light level 1 and 1 s, its variance, both (H, W, C), and saturated pixels (H, W).

        The variance is that of the sensor model, ``(relative * signal)² + (floor * full scale)²``, plus the variances
        of rounding to counts and of the mean black frame. A pixel is saturated if any of its channels is.
        """
        m = self.manifest
        full_scale = 2**m.bits - 1
        gain = np.float32(m.radiance_per_count / (frame.level * frame.exposure_s))
        # Rounding has the variance 1/12; the mean of n black frames has 1/n of the variance of one frame
        floor = ((m.sensor_noise_floor * full_scale) ** 2 + 1 / 12) * (1 + 1 / self.black_frames)
        radiance = np.subtract(counts, self.black, dtype=np.float32)
        radiance *= gain
        variance = np.maximum(radiance, np.float32(0))
        variance *= np.float32(m.sensor_noise_relative)
        variance *= variance
        variance += np.float32(floor) * gain**2
        if counts.max(initial=0) < full_scale:
            return radiance, variance, np.zeros(counts.shape[:2], dtype=bool)
        return radiance, variance, (counts >= full_scale).any(axis=-1)


class Merge:
    """Merge of exposures of the same light, weighted by inverse variance; a saturated pixel has weight 0.

    Where every exposure is saturated, radiance and variance are 0 and the pixel is flagged (never 0/0).
    """

    def __init__(self) -> None:
        self._exposures: list[tuple[Image, Image, BoolArray]] = []

    def add(self, radiance: Image, variance: Image, saturated: BoolArray) -> None:
        """Add one exposure that is aligned with the others. The arrays may be overwritten."""
        self._exposures.append((radiance, variance, saturated))

    def result(self) -> tuple[Image, Image, BoolArray]:
        """Merged radiance and variance (H, W, C), and the pixels (H, W) without a usable exposure."""
        if len(self._exposures) == 1:
            radiance, variance, lost = self._exposures[0]
            lost = lost.copy()
        else:
            weighted, weight = np.zeros_like(self._exposures[0][0]), np.zeros_like(self._exposures[0][0])
            for one, its_variance, saturated in self._exposures:
                own = np.where(saturated[..., None], np.float32(0), 1 / np.maximum(its_variance, np.float32(1e-30)))
                weight += own
                own *= one
                weighted += own
            lost = (weight == 0).any(axis=-1)
            np.maximum(weight, np.float32(1e-30), out=weight)
            radiance, variance = np.divide(weighted, weight, out=weighted), np.divide(1, weight, out=weight)
        if lost.any():
            radiance[lost], variance[lost] = 0, 0
        return radiance, variance, lost
