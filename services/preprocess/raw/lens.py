"""Lens distortion and vignetting, and their removal by resampling an image once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CalibratedCamera
from services.preprocess.views.window import BORDER_TOLERANCE_PX, Window

Image = NDArray[np.float32]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MOSAIC_PERIOD = 2
"""Period of a mosaic's pattern, pixels. A part cut out of a photograph begins at a multiple of it."""
REACH_PX = 4
"""Margin in pixels around samples that demosaicing and interpolation read."""
FLAT_BLOCK = 16
"""Side in pixels of a block of a flat field, whose mean is fitted: vignetting is smooth."""
MIN_BLOCKS = 16
"""Smallest number of blocks along an image's shorter side, as far as it has enough pixels."""


@dataclass(frozen=True)
class Lens:
    """Distortion and vignetting of a calibrated camera's lens.

    Attributes:
        camera: the calibrated camera.
        vignetting: a, b, c of the factor 1 + a q + b q² + c q³; zeros for a lens without vignetting. q is
            ``squared_distance``.
    """

    camera: CalibratedCamera
    vignetting: tuple[float, float, float]

    def distorted_positions(self, window: Window) -> Image | None:
        """Positions in the photograph of the pixels of a window of the undistorted image.

        Returns:
            x, y (H, W, 2) as indices, with pixel centres at whole numbers; None for a lens without distortion.
        """
        import cv2

        if self.camera.distortion is None or not any(self.camera.distortion):
            return None
        # Shift the principal point, because pixel centres are whole numbers in OpenCV and half-integers here.
        K = np.asarray(self.camera.K, dtype=np.float64) - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        shown = K - np.array([[0, 0, window.left], [0, 0, window.top], [0, 0, 0]])
        maps = cv2.initUndistortRectifyMap(
            K, np.array(self.camera.distortion), None, shown, window.shape[::-1], cv2.CV_32FC1
        )
        return np.ascontiguousarray(np.stack(maps, axis=-1), dtype=np.float32)

    def relative_brightness(self, x: Image, y: Image) -> Image | None:
        """Relative brightness of a uniform source at pixel indices of the photograph; None without vignetting."""
        if not any(self.vignetting):
            return None
        a, b, c = self.vignetting
        q = squared_distance(self.camera, x + 0.5, y + 0.5)
        return np.asarray(1 + q * (a + q * (b + q * c)), dtype=np.float32)


class Sampler:
    """Resampler of photographs to a window of the undistorted image, for distortion and motion in one interpolation.

    Attributes:
        region: the part of the photograph that is needed; its top and left are even.
    """

    def __init__(self, lens: Lens, window: Window) -> None:
        self._lens, self._window, self._size = lens, window, lens.camera.size
        self._distorted_positions = lens.distorted_positions(window)
        needed = window
        if self._distorted_positions is not None:
            (left, top), (right, bottom) = (
                bound(self._distorted_positions.reshape(-1, 2), axis=0) for bound in (np.min, np.max)
            )
            needed = Window(
                int(np.clip(top, 0, self._size[1] - 1)),
                int(np.clip(np.ceil(bottom), 0, self._size[1] - 1)) + 1,
                int(np.clip(left, 0, self._size[0] - 1)),
                int(np.clip(np.ceil(right), 0, self._size[0] - 1)) + 1,
            )
        grown = needed.grown(REACH_PX, self._size)
        self.region = Window(
            grown.top // MOSAIC_PERIOD * MOSAIC_PERIOD,
            grown.bottom,
            grown.left // MOSAIC_PERIOD * MOSAIC_PERIOD,
            grown.right,
        )

    @property
    def is_exact_at_rest(self) -> bool:
        """Whether the pixels of an unmoved subject need no interpolation."""
        return self._distorted_positions is None

    def positions(self, in_window: Image) -> Image:
        """Indices x, y (2, H, W) in the photograph of positions x, y (2, H, W) given as indices in the window."""
        import cv2

        if self._distorted_positions is None:
            return in_window + np.array([self._window.left, self._window.top], dtype=np.float32)[:, None, None]
        # Interpolate the lens's map, which is smooth; beyond the window its edge values are used.
        x, y = np.ascontiguousarray(in_window, dtype=np.float32)
        found = cv2.remap(self._distorted_positions, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(np.moveaxis(found, -1, 0))

    def source_window(self, positions: Sequence[Image]) -> Window:
        """Part of ``region`` whose rows contain the given positions (2, h, W) and the margin for demosaicing and
        interpolation.
        """
        low, high = min(float(one[1].min()) for one in positions), max(float(one[1].max()) for one in positions)
        region = self.region
        top = int(np.clip(np.floor(low) - REACH_PX, region.top, max(region.bottom - MOSAIC_PERIOD, region.top)))
        top = top // MOSAIC_PERIOD * MOSAIC_PERIOD
        bottom = int(np.clip(np.ceil(high) + 1 + REACH_PX, min(top + MOSAIC_PERIOD, region.bottom), region.bottom))
        return Window(top, bottom, region.left, region.right)

    def sampled(self, image: Image, positions: Image, loaded: Window | None = None) -> Image:
        """Interpolate an image linearly at indices of the photograph; 0 outside the image.

        Args:
            image: (h, w) or (h, w, C).
            positions: x, y (2, H, W) as indices of the photograph.
            loaded: the part of the photograph that the image covers; None for ``region``.

        Returns:
            Values (H, W, C).
        """
        import cv2

        loaded = self.region if loaded is None else loaded
        x, y = (
            np.ascontiguousarray(positions[k] - np.float32(start)) for k, start in ((0, loaded.left), (1, loaded.top))
        )
        planes = np.atleast_3d(image)
        # Split the channels, because OpenCV's remap takes at most four at once.
        parts = [
            np.atleast_3d(cv2.remap(np.ascontiguousarray(planes[..., k : k + 4]), x, y, cv2.INTER_LINEAR))
            for k in range(0, planes.shape[2], 4)
        ]
        return np.concatenate(parts, axis=2).astype(np.float32)

    def beyond(self, positions: Image) -> BoolArray:
        """Places (H, W) that lie beyond the photograph, so that interpolation mixes in black."""
        (x, y), (width, height) = positions, self._size
        return np.asarray(
            (x < -BORDER_TOLERANCE_PX)
            | (x > width - 1 + BORDER_TOLERANCE_PX)
            | (y < -BORDER_TOLERANCE_PX)
            | (y > height - 1 + BORDER_TOLERANCE_PX)
        )


def squared_distance(camera: CalibratedCamera, x_px: NDArray[np.floating], y_px: NDArray[np.floating]) -> FloatArray:
    """Squared distance q from the principal point, in units of half the image's diagonal."""
    width, height = camera.size
    return np.asarray(
        ((x_px - camera.K[0][2]) ** 2 + (y_px - camera.K[1][2]) ** 2) * 4 / (width**2 + height**2), dtype=np.float64
    )


def fitted_vignetting(camera: CalibratedCamera, flat: Image) -> tuple[float, float, float]:
    """Fit the vignetting a, b, c to an image (H, W, C) of a uniform source by least squares.

    The result is the mean over the channels, weighted by their usable blocks. Blocks with a pixel that is not finite
    are left out.
    """
    step = max(1, min(FLAT_BLOCK, *(length // MIN_BLOCKS for length in flat.shape[:2])))
    height, width = (length // step * step for length in flat.shape[:2])
    y, x = np.mgrid[0:height, 0:width]
    q = squared_distance(camera, x + 0.5, y + 0.5)
    terms = np.stack([_block_means(q**power, step) for power in range(4)], axis=1)
    found, weights = [], []
    for channel in range(flat.shape[2]):
        values = _block_means(flat[:height, :width, channel], step)
        usable = np.isfinite(values) & (values > 0)
        scale, *rest = np.linalg.lstsq(terms[usable], values[usable], rcond=None)[0]
        found.append(np.array(rest) / scale)
        weights.append(usable.sum())
    a, b, c = np.average(found, axis=0, weights=weights)
    return float(a), float(b), float(c)


def _block_means(image: NDArray[np.floating], step: int) -> FloatArray:
    height, width = image.shape
    blocks = image.reshape(height // step, step, width // step, step)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64)).ravel()
