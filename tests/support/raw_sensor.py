"""A camera that turns known radiance into counts, with shot noise, read noise, black level, rounding, mosaic, gains per
pixel (vignetting) and a nonlinear response.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """A sensor with known properties.

    Attributes:
        black: counts without light.
        read_counts: standard deviation of read noise, counts.
        counts_per_radiance: counts above black of radiance 1 at 1 s, one number per channel or for all.
        mosaic: letters of the 2 x 2 colour filters, row by row, or ``none``.
        bend: nonlinearity; counts s above black become s (1 + bend · s / full).
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
        """Convert an image of radiance (H, W, C) into counts (H, W, C), or (H, W) with a mosaic."""
        electrons = radiance * self.counts_per_radiance * exposure_s / self.counts_per_electron
        if self.mosaic != "none":
            electrons = taken_through(electrons, self.mosaic)
        signal = rng.poisson(np.maximum(electrons, 0)) * self.counts_per_electron * gain
        signal = signal * (1 + self.bend * signal / self.full)
        read = self.read_counts * gain * rng.standard_normal(signal.shape)
        return np.clip(np.rint(self.black + signal + read), 0, self.full).astype(np.uint16)


def taken_through(image: Array, mosaic: str) -> Array:
    """Apply the colour filters of a mosaic to an image (H, W, 3); returns (H, W)."""
    through = np.empty(image.shape[:2])
    for k, letter in enumerate(mosaic):
        through[k // 2 :: 2, k % 2 :: 2] = image[k // 2 :: 2, k % 2 :: 2, "RGB".index(letter)]
    return through


def even(shape: tuple[int, ...], value: float) -> Array:
    """An image of a uniform source."""
    return np.full(shape, value)


Scene = Callable[[int, int], Array]
