"""A camera that turns known radiance into counts: shot noise, read noise, black, rounding, mosaic, vignetting, a bent
response.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """A sensor of known numbers.

    Attributes:
        counts_per_radiance: counts above black of radiance 1 at 1 s, one number a channel or for all.
        bend: counts above black become s (1 + bend · s / full).
    """

    bits: int = 12
    black: float = 64.0
    read_counts: float = 2.0
    counts_per_electron: float = 0.5
    counts_per_radiance: float | Array = 1.0
    mosaic: str = "none"
    bend: float = 0.0

    @property
    def full(self) -> int:
        return 2**self.bits - 1

    def counts(
        self, radiance: Array, exposure_s: float, rng: np.random.Generator, gain: float = 1.0
    ) -> NDArray[np.uint16]:
        """Counts (H, W, C), or (H, W) of a mosaic, of an image (H, W, C)."""
        electrons = radiance * self.counts_per_radiance * exposure_s / self.counts_per_electron
        if self.mosaic != "none":
            electrons = taken_through(electrons, self.mosaic)
        signal = rng.poisson(np.maximum(electrons, 0)) * self.counts_per_electron * gain
        signal = signal * (1 + self.bend * signal / self.full)
        read = self.read_counts * gain * rng.standard_normal(signal.shape)
        return np.clip(np.rint(self.black + signal + read), 0, self.full).astype(np.uint16)


def taken_through(image: Array, mosaic: str) -> Array:
    """What the colour filters of a mosaic let through of an image (H, W, 3)."""
    through = np.empty(image.shape[:2])
    for k, letter in enumerate(mosaic):
        through[k // 2 :: 2, k % 2 :: 2] = image[k // 2 :: 2, k % 2 :: 2, "RGB".index(letter)]
    return through


def even(shape: tuple[int, ...], value: float) -> Array:
    """An even source."""
    return np.full(shape, value)


Scene = Callable[[int, int], Array]
