"""What the preparation reads: one image per camera and light, from a folder or from a captured rig."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from services.core.records import FolderCapture
from services.preprocess.projection import Footprint

Image = NDArray[np.float32]
Bits = NDArray[np.uint16]


@dataclass(frozen=True)
class LightImage:
    """One camera's view under one light.

    Attributes:
        radiance, variance: (H, W, C); where a value is not finite it is 0 and flagged.
        bits: (H, W), what the source knows: saturated, moved, not finite.
        displacement: (h, w, 2), pixels, every ``motion_step``-th; None where motion is not measured.
        motion_px: median over the teeth; None where motion is not measured.
        warped: whether the pixels were resampled.
    """

    radiance: Image
    variance: Image
    bits: Bits
    displacement: Image | None = None
    motion_px: float | None = None
    warped: bool = False


class Source(Protocol):
    """A capture to prepare."""

    @property
    def root(self) -> Path:
        """Folder that holds ``teeth/``."""

    @property
    def description(self) -> FolderCapture:
        """Cameras, lights, channels."""

    @property
    def held_out(self) -> tuple[tuple[str, str], ...]:
        """(camera, light) pairs that the source itself keeps from the fit."""

    @property
    def measures_motion(self) -> bool:
        """Whether images carry a displacement."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences the operator should read before trusting the result."""

    def lights_of(self, camera: int) -> tuple[int, ...]:
        """Indices of the lights this camera has an image of."""

    def images(self, camera: int, footprint: Footprint) -> Iterator[tuple[int, LightImage]]:
        """Light index and image, one at a time.

        Raises:
            CaptureInputError: names the file or frame, camera and light.
        """
