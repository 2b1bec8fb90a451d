"""Prepared images at the resolution that is fitted: squares of pixels averaged to one, none left out.

A square is the pixel of a camera with so many times fewer of them, so what a scene is rendered for is exactly what was
averaged.
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
    """The camera whose pixels are squares of ``step`` by ``step`` pixels; what is left of a square at the right and
    below is dropped.
    """
    first, second, last = camera.K
    width, height = camera.size
    return camera.model_copy(
        update={
            "size": (max(width // step, 1), max(height // step, 1)),
            "K": (tuple(one / step for one in first), tuple(one / step for one in second), last),
        }
    )


def averaged(values: NDArray[Any], step: int) -> Array:
    """Means (height // step, width // step) over squares of an image (height, width)."""
    height, width = (n // step for n in values.shape)
    squares = values[: height * step, : width * step].reshape(height, step, width, step)
    return np.asarray(squares.mean(axis=(1, 3), dtype=np.float64))


def whole_squares(chosen: BoolArray, step: int) -> BoolArray:
    """Squares (height // step, width // step) of which every pixel is chosen; a part of one would have another mean
    than what is rendered.
    """
    height, width = (n // step for n in chosen.shape)
    return np.asarray(chosen[: height * step, : width * step].reshape(height, step, width, step).all(axis=(1, 3)))


class LevelReader:
    """One channel of a prepared store, averaged.

    Args:
        store: ``prepared.zarr``. index: of the channel. step: pixels of a square's edge.
    """

    def __init__(self, store: Path, index: int, step: int) -> None:
        self._radiance, self._variance, self._valid = (
            StoredArray(store / name) for name in ("radiance", "variance", "valid")
        )
        self._index, self.step = index, step

    def image(self, number: int, light: int, camera: Camera) -> tuple[Array, Array]:
        """Radiance and its variance (H, W) of one image; errors of a square's pixels are independent, so their
        variances add.

        Args:
            camera: as it was before it was reduced.
        """
        width, height = camera.size
        radiance, variance = (
            averaged(stack[number, light, :height, :width, self._index], self.step)
            for stack in (self._radiance, self._variance)
        )
        return radiance, variance / self.step**2

    def bits(self, number: int, light: int, camera: Camera) -> NDArray[np.uint16]:
        """Mask bits (height, width) of one image, not reduced."""
        width, height = camera.size
        return np.asarray(self._valid[number, light, :height, :width], dtype=np.uint16)
