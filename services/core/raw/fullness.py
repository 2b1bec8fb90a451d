"""The counts from which a photograph's pixels are full.

A sensor may be full below the largest number that its bits hold: its wells are full before its converter is, or a
program multiplied the counts. Camera raw files state that count. In files of other formats it shows as many pixels that
end at one count, while few have the counts just below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.raw.mosaic import sites
from services.core.raw.records import RawCamera

Part = tuple[slice, slice] | tuple[NDArray[np.intp], ...]
"""Rows and columns of a frame, in a form that can index an array."""

MIN_FULL = 12
"""Least number of pixels at one count that are taken for full."""
TIMES_BELOW = 4.0
"""Least ratio of the number of pixels at that count to that at any of the ``LEVELS_BELOW`` counts below. Noise spreads
unsaturated light over several counts, so its highest count is the rarest one."""
LEVELS_BELOW = 4
MAX_ABOVE = 0.002
"""Largest share of stray pixels above that count, as a fraction of the pixels at it."""
MIN_SHARE = 0.05
"""Least share of full scale at which pixels are taken for full; darker counts may lie within rounding of each other."""
TOP_SHARE = 0.9
"""Share of the largest value above which floating-point values are counted."""


@dataclass(frozen=True)
class Fullness:
    """From which count on the pixels of one frame are full.

    Attributes:
        counts: count from which a pixel is full, one number for each of the pattern's four pixels or for each channel;
            infinite where it is not known.
        size: height and width of the frame in pixels.
        is_mosaic: whether the numbers are those of the pattern's four pixels.
        window: rows and columns that the file holds (top, bottom, left, right); None for all. Pixels outside it count
            as full, because they tell nothing.
    """

    counts: tuple[float, ...]
    size: tuple[int, int]
    is_mosaic: bool
    window: tuple[int, int, int, int] | None = None

    def limited(self, counts: Sequence[float]) -> Fullness:
        """The same with smaller counts where these are smaller."""
        least = tuple(min(own, other) for own, other in zip(self.counts, counts, strict=True))
        return Fullness(least, self.size, self.is_mosaic, self.window)

    def at(self, part: Part = (slice(None), slice(None))) -> NDArray[np.float32]:
        """Count from which the pixels of a part are full, in a shape that broadcasts to the part's counts.

        Pixels outside the window have minus infinity.
        """
        full = np.array(self.counts, dtype=np.float32)
        if np.all(full == full[0]):
            full = full[0]
        elif self.is_mosaic:
            rows, columns = self._indices(part)
            full = full.reshape(2, 2)[np.ix_(rows % 2, columns % 2)]
        if self.window is None:
            return np.asarray(full)
        rows, columns = self._indices(part)
        top, bottom, left, right = self.window
        inside = np.logical_and.outer((rows >= top) & (rows < bottom), (columns >= left) & (columns < right))
        inside = inside if self.is_mosaic else inside[..., None]
        return np.where(inside, full, np.float32(-np.inf)).astype(np.float32)

    def _indices(self, part: Part) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        rows, columns = part
        return np.arange(self.size[0])[rows].ravel(), np.arange(self.size[1])[columns].ravel()


def fullness_of(
    counts: NDArray[Any], camera: RawCamera, white: Sequence[float] | None, window: tuple[int, int, int, int] | None
) -> Fullness:
    """From which count on the pixels of a lit frame are full.

    Args:
        counts: (H, W) of a mosaic, else (H, W, C).
        white: counts that the file states for the pattern's four pixels or for all channels.
        window: rows and columns that the file holds.
    """
    planes = _planes(counts, camera, window)
    stated = float("inf") if camera.full_counts is None else camera.full_counts
    own = [stated] * len(planes) if white is None else [min(stated, one) for one in white]
    found = [piled_up(plane, stated) for plane in planes]
    full = tuple(limit if level is None else min(limit, level) for limit, level in zip(own, found, strict=True))
    return Fullness(full, counts.shape[:2], camera.mosaic != "none", window)


def _planes(counts: NDArray[Any], camera: RawCamera, window: tuple[int, int, int, int] | None) -> list[NDArray[Any]]:
    if camera.mosaic != "none":
        return [own for _, own in sites(counts, camera.mosaic)]
    if window is not None:
        counts = counts[window[0] : window[1], window[2] : window[3]]
    return [counts[..., channel] for channel in range(counts.shape[2])]


def piled_up(values: NDArray[Any], full_scale: float) -> float | None:
    """The count at which many of a channel's values end; None if there is none.

    Args:
        values: counts of one channel, any shape.
        full_scale: largest count that the file could hold; infinite where it is not known.
    """
    if values.size < MIN_FULL:
        return None
    levels, numbers = _top_levels(values)
    if len(levels) == 1:
        is_bright = np.isfinite(full_scale) and levels[0] >= MIN_SHARE * full_scale
        return float(levels[0]) if is_bright and numbers[0] == values.size else None
    above = np.cumsum(numbers) - numbers
    padded = np.concatenate([numbers, np.zeros(LEVELS_BELOW, dtype=numbers.dtype)])
    below = np.max([padded[k : k + len(numbers)] for k in range(1, LEVELS_BELOW + 1)], axis=0)
    is_end = (numbers >= MIN_FULL) & (numbers > TIMES_BELOW * below) & (above <= MAX_ABOVE * numbers)
    is_end[-1] = False  # Below the lowest count there is nothing to compare with.
    if np.isfinite(full_scale):
        is_end &= levels >= MIN_SHARE * full_scale
    found = np.flatnonzero(is_end)
    return float(levels[found[0]]) if len(found) else None


def _top_levels(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Distinct values from the highest down, and how many pixels have each."""
    if values.dtype == np.uint16:
        numbers = np.bincount(values.ravel())
        levels = np.flatnonzero(numbers)
        return levels[::-1], numbers[levels][::-1]
    top = float(values.max())
    kept = values[values >= TOP_SHARE * top] if top > 0 else values.ravel()
    found, numbers = np.unique(kept, return_counts=True)
    return found[::-1], numbers[::-1]
