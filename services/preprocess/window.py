"""The part of a camera's image that shows what is to be fitted: nothing else is read, computed or stored."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from services.core.geometry import Camera, Mesh, Vector3

MARGIN_PX = 32
"""Pixels kept around what is to be fitted: the checks of the pose look at its outline from outside."""
MARGIN_SHARE = 0.05
"""The same as a share of the longer side, for cameras with many pixels."""
BAND_PIXELS = 1 << 16
"""Pixels that are worked on at once: a dozen float32 arrays of so many stay in a processor's cache."""


@dataclass(frozen=True)
class Window:
    """Rows ``top`` to ``bottom`` and columns ``left`` to ``right`` of an image, ends excluded, in pixels."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.bottom - self.top, self.right - self.left

    @property
    def rows(self) -> slice:
        """Of the whole image."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Of the whole image."""
        return slice(self.left, self.right)

    def grown(self, by_px: int, size: tuple[int, int]) -> Window:
        """The same with so many pixels more on each side, as far as an image of ``size`` (width, height) has them."""
        return Window(
            max(self.top - by_px, 0),
            min(self.bottom + by_px, size[1]),
            max(self.left - by_px, 0),
            min(self.right + by_px, size[0]),
        )

    def within(self, outer: Window) -> tuple[slice, slice]:
        """Rows and columns of this window in an array that holds the outer one."""
        return (
            slice(self.top - outer.top, self.bottom - outer.top),
            slice(self.left - outer.left, self.right - outer.left),
        )

    def cropped(self, camera: Camera) -> Camera:
        """The camera whose whole image is this window."""
        first, second, last = camera.K
        K: tuple[Vector3, Vector3, Vector3] = (
            (first[0], first[1], first[2] - self.left),
            (second[0], second[1], second[2] - self.top),
            last,
        )
        return camera.model_copy(update={"size": self.shape[::-1], "K": K})


def window_of(camera: Camera, meshes: Sequence[Mesh]) -> Window:
    """The smallest window that holds the meshes' images and a margin; the whole image where they reach behind the
    camera or beside it.
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
    """Rows of an image of (height, width), a few at a time."""
    step = max(1, BAND_PIXELS // max(shape[1], 1))
    for top in range(0, shape[0], step):
        yield slice(top, min(top + step, shape[0]))


def bands_of(rows: slice, width: int) -> Iterator[slice]:
    """Some rows of an image of so many columns, a few at a time."""
    for part in bands((rows.stop - rows.start, width)):
        yield slice(rows.start + part.start, rows.start + part.stop)
