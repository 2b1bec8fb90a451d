"""Measured pixels of one camera, and the cells within which losses are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.fit.measurements.blocks import PixelParts

Array = NDArray[np.float64]

CELL_EDGE = 4
"""Edge of a comparison cell, in pixels of the coarse grid. Losses are compared as means over cells, because changes by
parameters are smooth and noise is not."""
MIN_CELLS = 24
"""Least number of cells of a view, approximately: cells are smaller where there would be fewer, so that the error of a
comparison can still be estimated."""


@dataclass(frozen=True)
class ViewStack:
    """Pixels of one camera in one channel; arrays over (light, pixel) are (L, N), with lights in the
    manifest's order.
    """

    camera: Camera
    pixels: NDArray[np.int32]
    reference: Array
    variance: Array
    valid: NDArray[np.bool_]
    held_out: NDArray[np.bool_]
    """Mask (L,) of the lights under which this camera's image is held out of the fit."""
    parts: PixelParts | None = None
    """Part of a jaw that each pixel shows; None where the scene is one tooth."""
    slopes: Array | None = None
    """Slopes (2, L, N) of the photographs along x and y, per pixel, and then their variances in variances of the
    photograph, (4, L, N) in all; None where no fit asks for them."""

    def of(self, pixels: NDArray[np.bool_]) -> ViewStack:
        """View of some of the pixels, by a mask (N,)."""
        parts = None if self.parts is None else self.parts.of(pixels)
        arrays = (self.reference[:, pixels], self.variance[:, pixels], self.valid[:, pixels])
        slopes = None if self.slopes is None else self.slopes[:, :, pixels]
        return ViewStack(self.camera, self.pixels[pixels], *arrays, self.held_out, parts, slopes)

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """Mask (L, N) of the measurements that the fit may use."""
        return self.valid & ~self.held_out[:, None]


def on_coarse_grid(pixels: NDArray[np.int32], counted: NDArray[np.bool_], max_pixels: int) -> NDArray[np.bool_]:
    """Mask (N,) of the pixels (N, 2) on a grid of every n-th in x and y, with the least n that leaves at most
    ``max_pixels`` of the counted pixels.
    """
    every = 1
    while (counted & (kept := (pixels % every == 0).all(axis=1))).sum() > max_pixels:
        every += 1
    return np.asarray(kept)


def comparison_cells(view: ViewStack, max_pixels: int) -> NDArray[np.int32]:
    """Index (N,) of each pixel's comparison cell. Cells are squares of a few pixels of the coarse grid, which has at
    most ``max_pixels`` fitted pixels; each cell shows one part only.
    """
    counted = np.asarray(view.fitted.any(axis=0))
    coarse = view.pixels[counted & on_coarse_grid(view.pixels, counted, max_pixels)]
    if not len(coarse):
        return np.zeros(len(view.pixels), dtype=np.int32)
    pitch = max(1, int(np.gcd.reduce((coarse - coarse[0]).ravel())))
    edge = pitch * max(1, min(CELL_EDGE, round(np.sqrt(len(coarse) / MIN_CELLS))))
    part = np.zeros(len(view.pixels), dtype=np.int64) if view.parts is None else view.parts.shown.astype(np.int64)
    place = np.column_stack([view.pixels // edge, part])
    return np.unique(place, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)
