"""From counts to radiance: black, gain, light, noise, saturation, and several exposures of one light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.records import CaptureManifest, FrameRecord

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Radiometry:
    """One camera's response, linear above its measured black.

    Attributes:
        black: (H, W, C) mean of the black frames, counts.
        black_frames: how many were averaged.
        manifest: gain, range and noise of the sensor.
    """

    black: Image
    black_frames: int
    manifest: CaptureManifest

    def radiance(self, counts: NDArray[np.uint16], frame: FrameRecord) -> tuple[Image, Image, BoolArray]:
        """Radiance at level 1 and 1 s, its variance, both (H, W, C), and where a channel is saturated (H, W).

        The noise is that of the sensor model, ``(relative * signal)² + (floor * full scale)²``, with rounding to counts and the black
        mean's own noise added.
        """
        m = self.manifest
        full_scale = 2**m.bits - 1
        signal = counts.astype(np.float32) - self.black
        floor = (m.sensor_noise_floor * full_scale) ** 2 + 1 / 12
        variance = (m.sensor_noise_relative * np.maximum(signal, 0)) ** 2 + np.float32(
            floor * (1 + 1 / self.black_frames)
        )
        gain = np.float32(m.radiance_per_count / (frame.level * frame.exposure_s))
        saturated: BoolArray = (counts >= full_scale).any(axis=-1)
        return (signal * gain).astype(np.float32), (variance * gain**2).astype(np.float32), saturated


class Merge:
    """Exposures of the same light joined by inverse variance; a saturated pixel has weight 0.

    Where every exposure is saturated there is no value: radiance 0, flagged (never 0/0).
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self._weighted = np.zeros(shape, dtype=np.float32)
        self._weight = np.zeros(shape, dtype=np.float32)

    def add(self, radiance: Image, variance: Image, saturated: BoolArray) -> None:
        """Add one exposure, aligned with the others."""
        weight = np.where(saturated[..., None], 0, 1 / np.maximum(variance, 1e-30)).astype(np.float32)
        self._weighted += weight * radiance
        self._weight += weight

    def result(self) -> tuple[Image, Image, BoolArray]:
        """Radiance and variance (H, W, C), and where no exposure was usable (H, W)."""
        weight = np.maximum(self._weight, 1e-30)
        lost: BoolArray = (self._weight == 0).any(axis=-1)
        return (
            (self._weighted / weight).astype(np.float32),
            np.where(lost[..., None], 0, 1 / weight).astype(np.float32),
            lost,
        )
