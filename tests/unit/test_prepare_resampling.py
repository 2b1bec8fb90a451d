"""Pixels of a moved frame whose samples reach beyond its border are not valid."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from services.core.records import FolderCapture, MaskBit
from services.core.results import CaptureManifest, FrameRecord
from services.preprocess.captures.radiometry import Radiometry
from services.preprocess.captures.rig import _image
from services.preprocess.stabilisation.motion import Displacement
from services.preprocess.views.window import Window

SHAPE = (6, 12)
BLACK, COUNTS = 64, 1064
FRAME = FrameRecord(index=1, kind="light", light="l", exposure_s=0.5, level=1.0, time_s=0, readback=(0, 0, 0))
CAPTURE = CaptureManifest(
    description=FolderCapture(units="mm", channels=("green",), cameras=(), lights=()),
    frames=(),
    bits=12,
    black_level=BLACK,
    radiance_per_count=0.5e-3,
    sensor_noise_relative=0.01,
    sensor_noise_floor=0.002,
    fdi=(11,),
)


WINDOW = Window(0, SHAPE[0], 0, SHAPE[1])


class Shifted:
    """Replaces a measured motion: every pixel is moved by the same vector."""

    window = WINDOW
    source = "tracking"

    def __init__(self, x_px: float, y_px: float) -> None:
        self._shift = np.array([x_px, y_px], dtype=np.float32)

    def move(self) -> Displacement:
        return Displacement(np.zeros(0), float(np.linalg.norm(self._shift)), 0.0)

    def positions(self, _: Displacement, rows: slice) -> np.ndarray:
        y, x = np.mgrid[rows, : SHAPE[1]].astype(np.float32)
        return np.stack([x + self._shift[0], y + self._shift[1]])

    def stored_field(self, _: Displacement) -> np.ndarray:
        return np.broadcast_to(self._shift, (*SHAPE, 2))


def test_pixels_that_mix_in_the_black_beyond_the_border_are_not_valid() -> None:
    radiometry = Radiometry(np.full((*SHAPE, 1), BLACK, np.float32), 4, CAPTURE)
    counts = np.full((*SHAPE, 1), COUNTS, np.uint16)
    for x_px, y_px in ((-3.5, 0.0), (2.25, 0.0), (0.0, -1.5), (0.0, 0.75), (-2.0, 1.0)):
        motion = Shifted(x_px, y_px)
        image = _image([FRAME], [motion.move()], radiometry, cast(Any, motion), lambda _: counts, WINDOW)
        y, x = np.indices(SHAPE)
        inside = (x + x_px >= 0) & (x + x_px <= SHAPE[1] - 1) & (y + y_px >= 0) & (y + y_px <= SHAPE[0] - 1)
        np.testing.assert_array_equal(image.bits, np.where(inside, 0, MaskBit.MOTION))
        np.testing.assert_allclose(image.radiance[inside], 1.0, rtol=1e-6)
