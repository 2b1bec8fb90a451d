"""Corners of boards as detected in photographs: the only input of lens and rig calibration."""

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
        place: number of the place where the board lay; the board did not move between photographs of one place.
        corners_mm: positions of the corners on the board (N, 3).
        pixels: detected positions of the corners (N, 2), pixel centres at half-integers.
        ids: numbers of the corners on the board (N,).
        name: name of the photograph, for messages.
    """

    camera: int
    place: int
    corners_mm: Floats
    pixels: Floats
    ids: NDArray[np.int64]
    name: str = ""

    def selected(self, mask: NDArray[np.bool_]) -> View:
        """Return the view with only the corners that the mask (N,) selects."""
        return replace(self, corners_mm=self.corners_mm[mask], pixels=self.pixels[mask], ids=self.ids[mask])


@dataclass(frozen=True)
class Corners:
    """All corners of all views, one row per corner.

    Attributes:
        camera: number of each corner's camera (N,).
        place: number of each corner's place (N,).
        view: number of each corner's view (N,).
        corners_mm: positions of the corners on their boards (N, 3).
        pixels: detected positions of the corners (N, 2).
    """

    camera: NDArray[np.int64]
    place: NDArray[np.int64]
    view: NDArray[np.int64]
    corners_mm: Floats
    pixels: Floats

    def selected(self, mask: NDArray[np.bool_]) -> Corners:
        """Return the corners that the mask (N,) selects."""
        return Corners(self.camera[mask], self.place[mask], self.view[mask], self.corners_mm[mask], self.pixels[mask])


def joined(views: Sequence[View]) -> Corners:
    """Return the corners of all views, in the order of the views."""
    counts = [len(view.pixels) for view in views]
    return Corners(
        camera=np.repeat([view.camera for view in views], counts).astype(np.int64),
        place=np.repeat([view.place for view in views], counts).astype(np.int64),
        view=np.repeat(np.arange(len(views)), counts).astype(np.int64),
        corners_mm=np.concatenate([view.corners_mm for view in views]).astype(np.float64),
        pixels=np.concatenate([view.pixels for view in views]).astype(np.float64),
    )
