"""All channels of every pixel of a mosaic, by linear filters, and the variance that sums over pixels then have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.raw.mosaic import site_channels, sites
from services.core.raw.records import Mosaic

Image = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

SUPPORT = 5
"""Pixels along the edge of a filter: what is full spoils as many around it."""
# Malvar, He and Cutler 2004, figure 2, in units of 1/8: bilinear interpolation with the other channels' curvature
# added.
_GREEN = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]])
_BESIDE = np.array([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]])
_ACROSS = np.array([[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]])
_SITES_OF_FOUR = (1, 2, 1)
"""How many of the four pixels of a pattern see red, green and blue."""


def channel_means(values: Image, mosaic: Mosaic) -> NDArray[np.float32]:
    """Mean brightness (3,) of red, green and blue in a mosaic (H, W)."""
    means = [np.mean([abs(float(own.mean())) for c, own in sites(values, mosaic) if c == k]) for k in range(3)]
    return np.array(means, dtype=np.float32)


def demosaic(values: Image, mosaic: Mosaic, means: NDArray[np.float32] | None = None) -> Image:
    """Image (H, W, 3) of a mosaic (H, W).

    Args:
        means: of the channels of the whole photograph that this is a part of; None where it is the whole. They are
            brought to one mean before and back after, since the filters take edges of one channel for those of another.
    """
    means = channel_means(values, mosaic) if means is None else means
    scale = np.where(means > 0, means / max(float(means.max()), 1e-30), 1).astype(np.float32)
    balanced = values.copy()
    for channel, own in sites(balanced, mosaic):
        np.divide(own, scale[channel], out=own)
    channels = site_channels(mosaic)
    image = np.repeat(balanced[..., None], 3, axis=2)
    filtered = {name: _filter(balanced, kernel) for name, kernel in _kernels().items()}
    for y in range(2):
        for x in range(2):
            own, place = channels[y, x], (slice(y, None, 2), slice(x, None, 2))
            for wanted in {0, 1, 2} - {own}:
                # A green pixel has the wanted colour beside it in its row or in its column; others have it at the
                # corners.
                beside = "row" if channels[y, 1 - x] == wanted else "column"
                name = "green" if wanted == 1 else beside if own == 1 else "across"
                image[*place, wanted] = filtered[name][place]
    image *= scale
    return image


def demosaic_variance(variance: Image, mosaic: Mosaic) -> Image:
    """Variance (H, W, 3) per pixel with which a sum over many pixels has its right error.

    Interpolated pixels share noise with their neighbours. A channel that one pixel in four sees has four times the
    variance of such a pixel, as if its pixels were independent.
    """
    import cv2

    channels, tent = site_channels(mosaic), np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)
    result = np.empty((*variance.shape, 3), dtype=np.float32)
    for k in range(3):
        seen = np.tile(channels == k, (-(-variance.shape[0] // 2), -(-variance.shape[1] // 2)))
        mask = seen[: variance.shape[0], : variance.shape[1]].astype(np.float32)
        blurred, weight = (
            cv2.filter2D(one, -1, tent, borderType=cv2.BORDER_REFLECT_101) for one in (variance * mask, mask)
        )
        result[..., k] = np.float32(4 / _SITES_OF_FOUR[k]) * blurred / weight
    return result


def spoiled(lost: BoolArray) -> BoolArray:
    """Pixels (H, W) whose filters reach one that is lost."""
    import cv2

    return np.asarray(cv2.dilate(lost.astype(np.uint8), np.ones((SUPPORT, SUPPORT), np.uint8)) > 0)


def _kernels() -> dict[str, NDArray[np.float64]]:
    return {"green": _GREEN, "row": _BESIDE, "column": _BESIDE.T, "across": _ACROSS}


def _filter(values: Image, kernel: NDArray[np.float64]) -> Image:
    import cv2

    # Mirrored without repeating the border, which keeps the pattern's parity.
    return np.asarray(cv2.filter2D(values, -1, (kernel / 8).astype(np.float32), borderType=cv2.BORDER_REFLECT_101))
