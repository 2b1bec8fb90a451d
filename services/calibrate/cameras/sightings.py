"""Corners of boards as cameras saw them: the one input of lens and rig calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """One board in one photograph.

    Attributes:
        camera: number of the camera.
        place: number of the place where the board lay; cameras that share it saw it unmoved.
        corners_mm: the corners on the board (N, 3).
        pixels: where they were seen (N, 2), pixel centres at half-integers.
        ids: the corners' numbers on the board (N,).
        name: of the photograph, for messages.
    """

    camera: int
    place: int
    corners_mm: Floats
    pixels: Floats
    ids: NDArray[np.int64]
    name: str = ""

    def kept(self, mask: NDArray[np.bool_]) -> View:
        """The same view with some of its corners."""
        return replace(self, corners_mm=self.corners_mm[mask], pixels=self.pixels[mask], ids=self.ids[mask])


@dataclass(frozen=True)
class Corners:
    """All corners of all views, one row a corner.

    Attributes:
        camera, place, view: numbers (N,).
        corners_mm: on their boards (N, 3).
        pixels: where they were seen (N, 2).
    """

    camera: NDArray[np.int64]
    place: NDArray[np.int64]
    view: NDArray[np.int64]
    corners_mm: Floats
    pixels: Floats

    def kept(self, mask: NDArray[np.bool_]) -> Corners:
        """Some of the corners."""
        return Corners(self.camera[mask], self.place[mask], self.view[mask], self.corners_mm[mask], self.pixels[mask])


def joined(views: Sequence[View]) -> Corners:
    """The corners of all views in their order."""
    counts = [len(view.pixels) for view in views]
    return Corners(
        camera=np.repeat([view.camera for view in views], counts).astype(np.int64),
        place=np.repeat([view.place for view in views], counts).astype(np.int64),
        view=np.repeat(np.arange(len(views)), counts).astype(np.int64),
        corners_mm=np.concatenate([view.corners_mm for view in views]).astype(np.float64),
        pixels=np.concatenate([view.pixels for view in views]).astype(np.float64),
    )
