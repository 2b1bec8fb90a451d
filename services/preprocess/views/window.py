"""The part of a camera's image that shows the fitted surfaces; nothing else is read, computed or stored."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from services.core.geometry import Camera, Mesh

MARGIN_PX = 32
"""Smallest margin around the fitted surfaces, pixels: the checks of the pose read pixels outside their outline."""
MARGIN_SHARE = 0.05
"""Smallest margin as a share of the longer side, for cameras with many pixels."""
BORDER_TOLERANCE_PX = 1e-3
"""Distance beyond the outermost pixel centres, pixels, up to which a sample is accepted. Interpolation mixes in the
black around the image by this fraction."""
BAND_PIXELS = 1 << 16
"""Approximate number of pixels processed at once: a dozen float32 arrays of this size fit in a processor's cache."""


@dataclass(frozen=True)
class Window:
    """Rows ``top`` to ``bottom`` and columns ``left`` to ``right`` of an image in pixels, ends excluded."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return self.bottom - self.top, self.right - self.left

    @property
    def rows(self) -> slice:
        """Rows of the whole image."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Columns of the whole image."""
        return slice(self.left, self.right)

    def grown(self, by_px: int, size: tuple[int, int]) -> Window:
        """Window enlarged by ``by_px`` pixels on each side, within an image of ``size`` (width, height)."""
        return Window(
            max(self.top - by_px, 0),
            min(self.bottom + by_px, size[1]),
            max(self.left - by_px, 0),
            min(self.right + by_px, size[0]),
        )

    def within(self, outer: Window) -> tuple[slice, slice]:
        """Rows and columns of this window in an array that holds the outer window."""
        return (
            slice(self.top - outer.top, self.bottom - outer.top),
            slice(self.left - outer.left, self.right - outer.left),
        )

    def cropped(self, camera: Camera) -> Camera:
        """Camera whose whole image is this window of the given camera's image."""
        return camera.cropped(self.rows, self.columns)


def window_of(camera: Camera, meshes: Sequence[Mesh]) -> Window:
    """Smallest window that holds the meshes' images and a margin.

    It is the whole image if a mesh reaches behind the camera or none lies in the image.
    """
    width, height = camera.size
    whole = Window(0, height, 0, width)
    projected = [camera.project(mesh.vertices_mm) for mesh in meshes]
    if not projected or any((depth <= 0).any() for _, depth in projected):
        return whole
    points = np.concatenate([image for image, _ in projected])
    left, top = np.clip(np.floor(points.min(axis=0)), 0, camera.size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(points.max(axis=0)), 0, camera.size).astype(int).tolist()
    if right <= left or bottom <= top:
        return whole
    margin = max(MARGIN_PX, int(MARGIN_SHARE * max(right - left, bottom - top)))
    return Window(top, bottom, left, right).grown(margin, camera.size)


def bands(shape: tuple[int, int]) -> Iterator[slice]:
    """Split an image of (height, width) into slices of a few rows."""
    step = max(1, BAND_PIXELS // max(shape[1], 1))
    for top in range(0, shape[0], step):
        yield slice(top, min(top + step, shape[0]))


def bands_of(rows: slice, width: int) -> Iterator[slice]:
    """Split some rows of an image of ``width`` columns into slices of a few rows."""
    for part in bands((rows.stop - rows.start, width)):
        yield slice(rows.start + part.start, rows.start + part.stop)
