"""Colour channels of the pixels of a mosaic, as a Bayer filter has them."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from services.core.raw.records import Mosaic

N = TypeVar("N", bound=np.generic)
CHANNEL_OF = {"R": 0, "G": 1, "B": 2}


def site_channels(mosaic: Mosaic) -> NDArray[np.intp]:
    """Channel (0 red, 1 green, 2 blue) of each pixel of the pattern, (2, 2), row by row."""
    return np.array([CHANNEL_OF[letter] for letter in mosaic], dtype=np.intp).reshape(2, 2)


def sites(counts: NDArray[N], mosaic: Mosaic) -> list[tuple[int, NDArray[N]]]:
    """For each of the pattern's four pixels, its channel and a view (H/2, W/2) of all pixels at that place."""
    channels = site_channels(mosaic)
    return [(int(channels[y, x]), counts[y::2, x::2]) for y in range(2) for x in range(2)]


def binned(counts: NDArray[Any], mosaic: Mosaic) -> NDArray[np.float32]:
    """Bin a mosaic to an image of half the size, (H // 2, W // 2, 3), without interpolation.

    Each channel is the mean of its pixels in each cell of 2 x 2. Red and blue are sampled a quarter of a binned pixel
    beside its centre, in opposite directions.
    """
    height, width = (length // 2 * 2 for length in counts.shape)
    image = np.zeros((height // 2, width // 2, 3), dtype=np.float32)
    for channel, view in sites(counts[:height, :width], mosaic):
        image[..., channel] += view.astype(np.float32) * np.float32(0.5 if channel == 1 else 1.0)
    return image
