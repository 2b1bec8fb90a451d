"""Prepared images at the resolution of the fit: squares of pixels are averaged to one pixel, and none is skipped.

A square is one pixel of a camera with fewer and larger pixels, so renders and averages cover exactly the same areas.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.core.store import StoredArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def reduced_camera(camera: Camera, step: int) -> Camera:
    """Camera whose pixels are squares of ``step`` by ``step`` pixels; incomplete squares at the right and at the bottom
    are dropped.
    """
    first, second, last = camera.K
    width, height = camera.size
    return camera.model_copy(
        update={
            "size": (max(width // step, 1), max(height // step, 1)),
            "K": (tuple(one / step for one in first), tuple(one / step for one in second), last),
        }
    )


def finer_camera(camera: Camera, count: int) -> Camera:
    """Camera with ``count`` by ``count`` pixels in place of each."""
    first, second, last = camera.K
    width, height = camera.size
    return camera.model_copy(
        update={
            "size": (width * count, height * count),
            "K": (tuple(one * count for one in first), tuple(one * count for one in second), last),
        }
    )


def averaged(values: NDArray[Any], step: int) -> Array:
    """Means (height // step, width // step) over squares of an image (height, width)."""
    height, width = (n // step for n in values.shape)
    squares = values[: height * step, : width * step].reshape(height, step, width, step)
    return np.asarray(squares.mean(axis=(1, 3), dtype=np.float64))


def whole_squares(chosen: BoolArray, step: int) -> BoolArray:
    """Mask (height // step, width // step) of the squares whose pixels are all chosen; the chosen part of a square
    would have another mean than the rendered whole.
    """
    height, width = (n // step for n in chosen.shape)
    return np.asarray(chosen[: height * step, : width * step].reshape(height, step, width, step).all(axis=(1, 3)))


class LevelReader:
    """Reader of one channel of a prepared store, averaged over squares.

    Args:
        store: path of ``prepared.zarr``.
        index: index of the channel.
        step: edge of a square, in pixels.
    """

    def __init__(self, store: Path, index: int, step: int) -> None:
        self._radiance, self._variance, self._valid = (
            StoredArray(store / name) for name in ("radiance", "variance", "valid")
        )
        self._index, self.step = index, step

    def image(self, number: int, light: int, camera: Camera) -> tuple[Array, Array]:
        """Radiance and its variance, (H, W) each, of one image. The errors of a square's pixels are independent, so
        their variances add.

        Args:
            number: index of the camera.
            light: index of the light.
            camera: the camera at full resolution.
        """
        width, height = camera.size
        radiance, variance = (
            averaged(stack[number, light, :height, :width, self._index], self.step)
            for stack in (self._radiance, self._variance)
        )
        return radiance, variance / self.step**2

    def bits(self, number: int, light: int, camera: Camera) -> NDArray[np.uint16]:
        """Mask bits (height, width) of one image at full resolution."""
        width, height = camera.size
        return np.asarray(self._valid[number, light, :height, :width], dtype=np.uint16)
