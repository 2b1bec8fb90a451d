"""The sensor of a virtual camera: light becomes electrons behind a mosaic of filters, and electrons become counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.core.raw.mosaic import site_channels
from services.core.raw.records import Mosaic

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """A sensor with shot noise, read noise and a black level.

    Attributes:
        bits: number of bits of a count.
        black: counts without light.
        full_well: electrons at the largest count.
        read_electrons: standard deviation of the noise without light.
        mosaic: colours of the 2 x 2 pixels at the upper left.
    """

    bits: int = 12
    black: float = 64.0
    full_well: float = 12_000.0
    read_electrons: float = 6.0
    mosaic: Mosaic = "RGGB"

    @property
    def full(self) -> int:
        """Largest count."""
        return int(2**self.bits - 1)

    @property
    def counts_per_electron(self) -> float:
        """Counts per electron at gain 1."""
        return (self.full - self.black) / self.full_well

    def photograph(
        self, camera: CalibratedCamera, radiance: Floats, exposure_s: float, random: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Counts (H, W) of an image of radiance (H, W, 3), or (H, W, 3) without a mosaic.

        Args:
            camera: camera with its ``radiance_per_count``.
            radiance: image on the sensor.
            exposure_s: exposure time, seconds.
            random: generator of the noise.
        """
        assert camera.radiance_per_count is not None
        through = self.filtered(radiance / np.array(camera.radiance_per_count))
        electrons = np.maximum(through, 0) * (exposure_s / self.counts_per_electron)
        # Draw shot noise from a normal distribution, which approximates Poisson noise of thousands of electrons; in the
        # dark the read noise is larger than the difference.
        noise = random.normal(size=electrons.shape) * np.sqrt(electrons + self.read_electrons**2)
        counts = self.black + (electrons + noise) * self.counts_per_electron
        return np.clip(np.rint(counts), 0, self.full).astype(np.uint16)

    def filtered(self, image: Floats) -> Floats:
        """Light (H, W) of an image (H, W, 3) that passes the mosaic's filters; the image itself without a mosaic."""
        if self.mosaic == "none":
            return image
        through = np.empty(image.shape[:2])
        for (row, column), channel in np.ndenumerate(site_channels(self.mosaic)):
            through[row::2, column::2] = image[row::2, column::2, channel]
        return through
